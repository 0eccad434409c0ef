"""Syntax trees of sources, which many rules look at: each is parsed once."""

import ast
from functools import cache


@cache
def parsed(source):
    """The tree of a text; nobody may change it."""
    return ast.parse(source)
