"""The page in a browser: a dash app on an inspection, for this machine alone unless told otherwise."""

from __future__ import annotations

from torchrl_etdmpc.inspector.page.app import make_page
from torchrl_etdmpc.inspector.page.controls import slider_range
from torchrl_etdmpc.inspector.page.server import serve

__all__ = ["make_page", "serve", "slider_range"]
