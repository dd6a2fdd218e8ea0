"""An error in one line."""

from __future__ import annotations


def first_line(error: BaseException) -> str:
    """The first line of an error's text, or its type's name if it has none.

    >>> first_line(ValueError())
    'ValueError'
    """
    return (str(error).strip() or type(error).__name__).splitlines()[0]
