"""report.json and report.html: the same facts for programs and for people."""

from lvba.products.report.output import page, to_json, write

__all__ = ["page", "to_json", "write"]
