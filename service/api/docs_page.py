"""The API as one page of plain HTML, made from its OpenAPI description: no script, nothing from elsewhere."""

from html import escape
from typing import Any

_STYLE = "/docs.css"
STYLE = """\
:root { color-scheme: light dark; font-family: system-ui, sans-serif; line-height: 1.5 }
body { max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
section { border-top: 1px solid #8888; padding: .5rem 0 }
h2 { margin-top: 2.5rem } h3 { font: 600 1rem ui-monospace, monospace; margin: .5rem 0 }
table { border-collapse: collapse } td, th { padding: .1rem .8rem .1rem 0; text-align: left; vertical-align: top }
code { font-family: ui-monospace, monospace }
"""


def page(description: dict[str, Any]) -> str:
    """The page."""
    groups: dict[str, list[str]] = {}
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            group = (operation.get("tags") or ["other"])[0]
            groups.setdefault(group, []).append(_operation(method, path, operation, description))
    parts = [f"<h2>{escape(group)}</h2>{''.join(operations)}" for group, operations in groups.items()]
    info = description["info"]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(info["title"])}</title>'
        '<meta name="viewport" content="width=device-width">'
        f'<link rel="stylesheet" href="{_STYLE}"></head><body><main><h1>{escape(info["title"])} '
        f"{escape(info['version'])}</h1><p>{escape(info.get('description', ''))} "
        f'For programs: <a href="/openapi.json">openapi.json</a>.</p>{"".join(parts)}</main></body></html>'
    )


def _operation(method: str, path: str, operation: dict[str, Any], description: dict[str, Any]) -> str:
    rows = [
        _row(
            f"{parameter['name']} ({parameter['in']})",
            parameter.get("schema", {}),
            parameter.get("required", False),
        )
        for parameter in operation.get("parameters", [])
    ]
    rows += _body_rows(operation, description)
    table = f"<table>{''.join(rows)}</table>" if rows else ""
    text = escape(operation.get("description", ""))
    return f"<section><h3>{method.upper()} {escape(path)}</h3><p>{text}</p>{table}</section>"


def _body_rows(operation: dict[str, Any], description: dict[str, Any]) -> list[str]:
    content = operation.get("requestBody", {}).get("content", {})
    schema = _resolved(content.get("application/json", {}).get("schema", {}), description)
    required = schema.get("required", [])
    return [
        _row(name, _resolved(inner, description), name in required)
        for name, inner in schema.get("properties", {}).items()
    ]


def _resolved(schema: dict[str, Any], description: dict[str, Any]) -> dict[str, Any]:
    for option in [schema, *schema.get("anyOf", [])]:
        if "$ref" in option:
            resolved: dict[str, Any] = description["components"]["schemas"][option["$ref"].rsplit("/", 1)[1]]
            return resolved
    return schema


def _row(name: str, schema: dict[str, Any], required: bool) -> str:
    kinds = [str(one.get("type", "")) for one in schema.get("anyOf", [schema])]
    kind = " or ".join(kind for kind in kinds if kind) or "one of " + ", ".join(
        map(str, schema.get("enum", []))
    )
    need = "required" if required else ""
    return f"<tr><td><code>{escape(name)}</code></td><td>{escape(kind)}</td><td>{need}</td></tr>"
