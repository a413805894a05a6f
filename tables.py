"""Tables of any content: plain text for a terminal, Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

FORMATS = ("md", "csv", "tex")
MISSING = "–"


class TableCell(NamedTuple):
    lines: tuple[str, ...]
    """The first is the value. The others stand below it or, on one line, after it."""
    bold: bool = False
    missing: bool = False
    merge: bool = False
    """LaTeX merges equal neighbours of this kind into one cell."""
    tex: str | None = None
    """LaTeX of the first line, if it differs from the text."""


@dataclass
class Table:
    name: str
    title: str
    header: list[str]
    labels: int
    """How many leading columns name the row. They are aligned left."""
    sections: list[list[list[TableCell]]]
    """Rows of cells; a rule separates the sections."""
    records: list[dict[str, Any]]
    """The same content in full precision for CSV: one record for each cell or row."""
    spans: dict[str, int] = field(default_factory=dict)
    """LaTeX headings above several columns: heading -> number of columns, from the first column after the labels."""


def text_cells(*texts: str) -> list[TableCell]:
    return [TableCell((text,), missing=text == MISSING) for text in texts]


def to_terminal(table: Table, bold: bool, width: int | None) -> str:
    """Plain text without empty columns. Columns beyond `width` characters (None: no limit) form a block below."""
    rows = [row for section in table.sections for row in section]
    widths = [
        max([len(head), *(len(line) for row in rows for line in row[j].lines)]) for j, head in enumerate(table.header)
    ]
    labels = list(range(table.labels))
    blocks: list[list[int]] = [[*labels]]
    for j in range(table.labels, len(table.header)):
        if all(row[j].missing for row in rows):
            continue
        if width and len(blocks[-1]) > table.labels and sum(widths[i] + 2 for i in [*blocks[-1], j]) - 2 > width:
            blocks.append([*labels])
        blocks[-1].append(j)

    def line(block: list[int], texts: list[str], emphasis: list[bool]) -> str:
        padded = [
            text.ljust(widths[j]) if j < table.labels else text.rjust(widths[j])
            for j, text in zip(block, texts, strict=True)
        ]
        styled = [f"\x1b[1m{text}\x1b[0m" if on else text for text, on in zip(padded, emphasis, strict=True)]
        return "  ".join(styled).rstrip()

    output = [table.title]
    for block in blocks:
        rule = "─" * (sum(widths[j] + 2 for j in block) - 2)
        output += ["", line(block, [table.header[j] for j in block], [False] * len(block))]
        for section in table.sections:
            output.append(rule)
            for row in section:
                cells = [row[j] for j in block]
                for i in range(max(len(cell.lines) for cell in cells)):
                    texts = [cell.lines[i] if i < len(cell.lines) else "" for cell in cells]
                    output.append(line(block, texts, [bold and cell.bold and i == 0 for cell in cells]))
    return "\n".join(output) + "\n"


def to_markdown(table: Table) -> str:
    def cell(content: TableCell) -> str:
        value, *rest = content.lines
        return " ".join([f"**{value}**" if content.bold else value, *rest])

    lines = [table.header, [":--" if j < table.labels else "--:" for j in range(len(table.header))]]
    lines += [[cell(content) for content in row] for section in table.sections for row in section]
    escaped = ([text.replace("|", r"\|") for text in line] for line in lines)
    return f"{table.title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in escaped)


def to_latex(table: Table) -> str:
    """A LaTeX document of one table. With the package `standalone`, \\input takes it too."""
    alignment = "l" * table.labels + "r" * (len(table.header) - table.labels)
    body = [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule"]
    heads = list(table.header)
    if table.spans:
        column, spans, rules = table.labels, [""] * table.labels, ""
        for name, count in table.spans.items():
            spans.append(rf"\multicolumn{{{count}}}{{c}}{{{_escape(name)}}}")
            rules += rf"\cmidrule(lr){{{column + 1}-{column + count}}}"
            heads[column : column + count] = [head.removeprefix(f"{name} ") for head in heads[column : column + count]]
            column += count
        body += [_latex_line(spans), rules]
    body.append(_latex_line([_escape(head) for head in heads]))
    for section in table.sections:
        body.append(r"\midrule")
        for number, row in enumerate(section):
            if number and max(len(cell.lines) for cell in row) > 1:
                body.append(r"\addlinespace")
            body += _latex_row(row)
    body += [r"\bottomrule", r"\end{tabular}"]
    preamble = [
        r"\documentclass[border=4pt]{standalone}",
        r"\usepackage{amsmath, booktabs}",
        r"\begin{document}",
    ]
    return "\n".join([f"% {table.title}", *preamble, *body, r"\end{document}"]) + "\n"


def _latex_row(row: Sequence[TableCell]) -> list[str]:
    # Equal neighbours that merge form one group; every other cell is its own group.
    merged = [list(group) for _, group in groupby(enumerate(row), lambda item: item[1] if item[1].merge else item[0])]
    lines = []
    for i in range(max(1 if cell.merge else len(cell.lines) for cell in row)):
        texts = []
        for group in merged:
            cell = group[0][1]
            if cell.merge:
                text = _escape(" ".join(cell.lines)) if i == 0 else ""
                texts.append(text if len(group) == 1 else rf"\multicolumn{{{len(group)}}}{{c}}{{{text}}}")
                continue
            text = _escape(cell.lines[i]) if i < len(cell.lines) else ""
            if i == 0 and cell.tex is not None:
                text = cell.tex
            texts.append(rf"\textbf{{{text}}}" if cell.bold and i == 0 else text)
        lines.append(_latex_line(texts))
    return lines


def _latex_line(texts: Sequence[str]) -> str:
    return " & ".join(texts) + r" \\"


_ESCAPED = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": "$<$",
    ">": "$>$",
}
"""Characters that LaTeX reads as commands, with their replacements."""


def _escape(text: str) -> str:
    text = re.sub("[" + re.escape("".join(_ESCAPED)) + "]", lambda found: _ESCAPED[found[0]], text)
    text = re.sub(r"(?<![\w-])-(?=[\d.])", "$-$", text)
    return text.replace("±", r"$\pm$").replace("–", "--").replace("†", r"$^\dagger$")


def write_csv(path: Path, records: Sequence[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def print_table(table: Table) -> None:
    screen = sys.stdout.isatty()
    print(to_terminal(table, bold=screen, width=shutil.get_terminal_size().columns if screen else None))


def write_table(table: Table, folder: Path, formats: Sequence[str], note: str = "") -> list[Path]:
    """Write `table` to `folder` in the `formats` of tables, with `note` below the Markdown. Returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for suffix in formats:
        path = folder / f"{table.name}.{suffix}"
        if suffix == "csv":
            write_csv(path, table.records)
        elif suffix == "md":
            path.write_text(to_markdown(table) + (f"\n{note}" if note else ""), encoding="utf-8")
        elif suffix == "tex":
            path.write_text(to_latex(table), encoding="utf-8")
        else:
            continue
        written.append(path)
    return written
