"""Settings of the site. Its sources are the repository, so that links between files are the same here and on the code
host; `make docs` builds it.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT / "src")]
os.environ.setdefault("MUJOCO_GL", "disable")

import generate  # noqa: E402
from sphinx.util.inspect import signature as signature_of  # noqa: E402
from sphinx.util.inspect import stringify_signature  # noqa: E402

import torchrl_etdmpc  # noqa: E402

project = "torchrl_etdmpc"
author = "torchrl_etdmpc contributors"
project_copyright = author
release = version = torchrl_etdmpc.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.doctest",
    "sphinx.ext.intersphinx",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "mathml",
]
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "benchmarks/**.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "src/torchrl_etdmpc/analysis/reference/README.md",
]
exclude_patterns = [
    ".*",
    "**/.*",
    "**.ipynb",
    "**.py",
    "**.json",
    "build",
    "dist",
    "runs",
    "tests",
    "examples",
    "docs/tutorials",  # the sources; their pages are in docs/gallery
    "docs/generated/parts",
    "benchmarks/results/**/auc.md",  # without headings: their tables are in the report
    "benchmarks/results/**/final.md",
    "docs/gallery/sg_execution_times.rst",
]
nitpicky = True
# Of TorchRL's names those that are mentioned: their pages are found without a network. A page of an older version
# stands for a name that the newer ones' reference leaves out.
intersphinx_mapping = {"torchrl": ("https://docs.pytorch.org/rl/", "docs/inventories/torchrl.txt")}
nitpick_ignore_regex = [
    (r"py:class", r"[a-z]+|Path|Tensor|NestedKey|Logger|nn\.Module"),  # types in a docstring's lists
    (r"py:class", r".*\._AcceptedKeys"),  # of TorchRL's losses: described with the class
]

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 4
suppress_warnings = [
    "config.cache",  # the gallery's settings hold functions
]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say types, with shapes and units
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_use_ivar = False
napoleon_use_keyword = False
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = "torchrl_etdmpc"
html_favicon = "_static/favicon.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]
html_show_sphinx = False
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
pygments_style = "friendly"
pygments_dark_style = "monokai"

sphinx_gallery_conf = {
    "examples_dirs": ["docs/tutorials"],
    "gallery_dirs": ["docs/gallery"],
    "filename_pattern": r"/\d\d_",
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "parallel": 2,  # tutorials at a time, each in a process of its own
    "plot_gallery": "True",
    "download_all_examples": False,
    "remove_config_comments": True,
    "capture_repr": (),
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1,
    "reset_modules": ("matplotlib", "reset.tutorial"),
    "image_scrapers": ("matplotlib",),
    "matplotlib_animations": False,
    "copyfile_regex": r".*\.yaml",
    "nested_sections": False,
}


def _for_the_site(app, docname, source) -> None:
    """A link to a folder leads to a file in it, and the tests' mark of a block that cannot run alone is left out."""
    folder = (ROOT / docname).parent
    source[0] = re.sub(r"```python fragment", "```python", source[0])
    source[0] = re.sub(r"\]\(([^)#:]+)\)", lambda link: f"]({_file(folder, link[1])})", source[0])


def _file(folder: Path, link: str) -> str:
    if not (folder / link).is_dir():
        return link
    inside = [*sorted((folder / link).glob("README.md")), *sorted((folder / link).rglob("*.csv"))]
    inside += sorted((folder / link).glob("*.*"))
    return os.path.relpath(inside[0], folder)


def _constructor(app, what, name, obj, options, signature, returns):
    """The arguments of a class whose metaclass hides them."""
    if what == "class" and signature == "(*args, **kwargs)":
        return stringify_signature(signature_of(obj.__init__, bound_method=True), show_annotation=False), returns
    return None


def _no_type(app, what, name, obj, options, lines) -> None:
    """Of an attribute's text, what stands before a colon is not a type."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]


def setup(app) -> None:
    warnings.filterwarnings("ignore", message=".*auto_register_policy_transforms.*", category=FutureWarning)
    app.connect("builder-inited", lambda app: generate.write(DOCS / "generated"), priority=1)
    app.connect("source-read", _for_the_site)
    app.connect("autodoc-process-signature", _constructor)
    app.connect("autodoc-process-docstring", _no_type, priority=1)
