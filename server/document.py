"""A page of headings, text, tables and pictures, as Markdown and as one HTML file that needs no other."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

_STYLE = """\
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #1a1a1a; background: #fff }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; margin: 1em 0; display: block; overflow-x: auto }
th, td { padding: .25em .6em; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }
th:first-child, td:first-child { text-align: left }
pre { background: #f4f4f4; padding: .7em; white-space: pre-wrap }
img { max-width: 100% }"""


@dataclass(frozen=True)
class Heading:
    level: int
    text: str


@dataclass(frozen=True)
class Text:
    text: str


@dataclass(frozen=True)
class Code:
    text: str


@dataclass(frozen=True)
class Table:
    """Cells of plain text; a `title` folds it away until the reader opens it."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str | None = None


@dataclass(frozen=True)
class Picture:
    """Markdown names the PNG beside it, `NAME.png`; HTML holds the SVG itself."""

    name: str
    description: str
    svg: bytes


Block = Heading | Text | Code | Table | Picture


def markdown(blocks: Sequence[Block]) -> str:
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def html_page(title: str, blocks: Sequence[Block]) -> str:
    head = f'<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n<style>\n{_STYLE}\n</style>'
    body = "\n".join(_html(block) for block in blocks)
    return f'<!doctype html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{body}\n</body>\n</html>\n'


def _markdown(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"{'#' * level} {_plain(text)}"
        case Text(text):
            return _plain(text)
        case Code(text):
            return "\n".join(f"    {line}" for line in text.splitlines())
        case Picture(name, description):
            return f"![{_plain(description)}]({name}.png)"
        case Table(heads, rows, title):
            lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
            table = "\n".join(table_line([_plain(cell) for cell in line]) for line in lines)
            return table if title is None else f"<details><summary>{html.escape(title)}</summary>\n\n{table}\n\n</details>"


def table_line(cells: Sequence[str]) -> str:
    """A row of a Markdown table, of cells in Markdown."""
    return f"| {' | '.join(cells)} |"


def _plain(text: str) -> str:
    """Text in which nothing is taken for Markdown."""
    for mark in "\\`*_[]<|":
        text = text.replace(mark, f"\\{mark}")
    return text


def _html(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Text(text):
            return f"<p>{html.escape(text)}</p>"
        case Code(text):
            return f"<pre>{html.escape(text)}</pre>"
        case Picture(_, description, svg):
            source = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"
            return f'<p><img alt="{html.escape(description)}" src="{source}"></p>'
        case Table(heads, rows, title):
            lines = [f"<tr>{''.join(f'<th>{html.escape(cell)}</th>' for cell in heads)}</tr>"]
            lines += [f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
            table = "<table>\n" + "\n".join(lines) + "\n</table>"
            return table if title is None else f"<details><summary>{html.escape(title)}</summary>\n{table}\n</details>"
