"""What every HTML page of this program is made of: the skeleton, its look, text, tables, embedded pictures.

A page needs nothing else: style and pictures are inside, there is no script, and it follows the reader's choice of
light or dark.
"""

import base64
import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image

from twofold.errors import TwofoldError
from twofold.images import read_header


@dataclass(frozen=True)
class Verdict:
    """One of the large numbers at the top.

    Attributes:
        label: what it is.
        value: as it is to be read, "27.1".
        unit: behind the value.
        goal: what it should be, "at least 26 dB"; empty for none.
        met: whether it is.
    """

    label: str
    value: str
    unit: str = ""
    goal: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Table:
    """Lines of text under headings; a line of a single cell is a heading within the table."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def document(title: str, body: str, style: str = "") -> bytes:
    """A whole page around `body`, with `style` after the common one."""
    head = (
        '<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content="width=device-width">'
        f'<meta name=color-scheme content="light dark"><title>{html.escape(title)}</title><style>{STYLE}{style}</style>'
    )
    # A file's name may hold bytes that are no text.
    return f"{head}<body>{body}</body></html>\n".encode(errors="replace")


def header(title: str, under: str, lead: str = "") -> str:
    """The top of a page.

    Args:
        title: of the page, as text.
        under: what stands below it, as HTML.
        lead: what stands beside both, as HTML.
    """
    beside = f"<div class=lead>{lead}</div>" if lead else ""
    return (
        f"<header class={'split' if lead else 'plain'}><div class=title><p class=brand>{LOGO}twofold</p>"
        f"<h1>{inline(title)}</h1>{under}</div>{beside}</header>"
    )


def tiles(verdicts: Sequence[Verdict]) -> str:
    """Large numbers side by side."""
    return f"<dl class=verdicts>{''.join(map(_tile, verdicts))}</dl>"


def table_html(table: Table) -> str:
    """A table of texts."""
    rows: list[str] = []
    for row in table.rows:
        if len(row) == 1:
            rows.append(f"<tr class=group><th colspan={len(table.columns)}>{inline(row[0])}</th></tr>")
        else:
            rows.append(f"<tr>{''.join(f'<td>{inline(cell)}</td>' for cell in row)}</tr>")
    head = "".join(f"<th>{inline(name)}</th>" for name in table.columns)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def inline(text: str) -> str:
    """Escaped text with `code` and links."""
    escaped = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"https?://[^\s<]*[^\s<.,;:)]", r'<a href="\g<0>">\g<0></a>', escaped)


def paragraphs(text: str) -> str:
    """Text whose paragraphs are parted by blank lines."""
    return "".join(f"<p>{inline(paragraph)}</p>" for paragraph in re.split(r"\n\s*\n", text.strip()) if paragraph)


def embedded(
    picture: Path | UInt8[ndarray, "h w 3"], kind: Literal["png", "jpeg"] = "png"
) -> tuple[str, tuple[int, int]]:
    """A picture as an address that holds it, and its width and height.

    Args:
        picture: a file (PNG, JPEG, WebP), taken as it is, or pixels.
        kind: how pixels are stored.

    Raises:
        TwofoldError: the file is missing or of another kind.
    """
    if isinstance(picture, Path):
        kinds = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}
        found = kinds.get(picture.suffix.lower())
        if found is None or not picture.is_file():
            problem = "is missing" if found else f"is no {', '.join(kinds)}"
            raise TwofoldError(f"The report's picture {picture} {problem}.")
        header = read_header(picture)
        content, stored, size = picture.read_bytes(), found, (header.width, header.height)
    else:
        buffer, image = io.BytesIO(), Image.fromarray(picture)
        image.save(buffer, kind.upper(), optimize=True)
        content, size, stored = buffer.getvalue(), image.size, kind
    return f"data:image/{stored};base64,{base64.b64encode(content).decode()}", size


def _tile(v: Verdict) -> str:
    tone = "" if v.met is None else " class=met" if v.met else " class=missed"
    mark = "" if v.met is None else "✓ " if v.met else "✗ "
    goal = f"<dd class=goal>{mark}{html.escape(v.goal)}</dd>" if v.goal else ""
    unit = f" <small>{html.escape(v.unit)}</small>" if v.unit else ""
    return f"<div{tone}><dt>{inline(v.label)}</dt><dd class=value>{html.escape(v.value)}{unit}</dd>{goal}</div>"


LOGO = (
    "<svg viewBox='0 0 24 24' aria-hidden=true><path d='M3 5l9-3v17l-9 3z' opacity=.55 />"
    "<path d='M12 2l9 3v17l-9-3z'/></svg>"
)
STYLE = """
:root{--paper:#fbfbfa;--card:#fff;--ink:#1d2026;--faint:#636975;--line:#e3e4e6;--accent:#1f6f8b;--good:#1c7a4d;
--bad:#b3491b;--c0:#1f6f8b;--c1:#d1662a;--c2:#3d9a5f;--c3:#8a56b8;--c4:#7d838d}
@media(prefers-color-scheme:dark){:root{--paper:#14161a;--card:#1c1f25;--ink:#e9eaec;--faint:#9aa1ac;--line:#30343c;
--accent:#6fc1dc;--good:#62c794;--bad:#ef9a6b;--c0:#6fc1dc;--c1:#f0995f;--c2:#7fd09c;--c3:#c29be6;--c4:#a3a9b3}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;-webkit-text-size-adjust:100%}
header,main,footer{max-width:1120px;margin:auto;padding:0 28px}
header{padding-top:48px;padding-bottom:12px}
.split{display:grid;grid-template-columns:1fr minmax(240px,340px);gap:44px;align-items:center}
.brand{margin:0 0 10px;color:var(--accent);font-weight:600;letter-spacing:.02em;display:flex;gap:8px;align-items:center}
.brand svg{width:20px;fill:currentColor}
h1{font-size:clamp(28px,4.4vw,44px);line-height:1.12;letter-spacing:-.02em;margin:0 0 12px;text-wrap:balance}
h2{font-size:24px;letter-spacing:-.01em;line-height:1.2;margin:0 0 8px}
h3{font-size:15px;margin:22px 0 8px}
header p:not(.brand){color:var(--faint);margin:0 0 8px;max-width:62ch}
section{padding:36px 0 12px;border-top:1px solid var(--line);margin-top:36px}
section>p{max-width:72ch;margin:0 0 12px}
a{color:var(--accent)}
code,pre,td:first-child{font-family:ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace;
font-size:.88em}
figure{margin:0;min-width:0}
img,video{display:block;width:100%;height:auto;border-radius:8px;background:#fff;outline:1px solid var(--line)}
figcaption{color:var(--faint);font-size:14px;line-height:1.4;margin-top:7px}
.verdicts{display:grid;grid-template-columns:repeat(auto-fit,minmax(148px,1fr));gap:12px;margin:26px 0 0}
.verdicts>div{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:14px 16px}
.verdicts dt{color:var(--faint);font-size:14px;line-height:1.3}
.verdicts dd{margin:0}
.value{font-size:30px;font-weight:650;letter-spacing:-.02em;line-height:1.3;white-space:nowrap;
font-variant-numeric:tabular-nums}
.value small{font-size:15px;font-weight:400;letter-spacing:0;color:var(--faint)}
.goal{font-size:13px;color:var(--faint)}
.met .goal{color:var(--good)}.missed .goal{color:var(--bad)}
.strip{display:grid;grid-auto-flow:column;grid-auto-columns:minmax(0,1fr);gap:12px;margin:14px 0 6px;align-items:start}
.charts,.videos{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,420px),1fr));gap:22px;margin:16px 0}
.videos{grid-template-columns:repeat(auto-fill,minmax(min(100%,300px),1fr))}
.charts figure{background:var(--card);border:1px solid var(--line);border-radius:12px;padding:14px 16px 8px;
max-width:549px}
.charts figcaption{margin:0 0 6px;display:flex;gap:4px 16px;flex-wrap:wrap}
.charts b{color:var(--ink);font-weight:600;margin-right:auto}
.charts span::before{content:"";display:inline-block;width:12px;height:3px;border-radius:2px;background:var(--c);
margin-right:6px;vertical-align:middle}
.c0{--c:var(--c0)}.c1{--c:var(--c1)}.c2{--c:var(--c2)}.c3{--c:var(--c3)}.c4{--c:var(--c4)}
svg{overflow:visible}
svg text{font-size:13px;fill:var(--faint);font-variant-numeric:tabular-nums}
.grid{stroke:var(--line)}
polyline{fill:none;stroke:var(--c);stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
.range{fill:var(--c);opacity:.16}
table{border-collapse:collapse;width:100%;margin:12px 0;font-size:15px}
th,td{text-align:left;padding:7px 14px 7px 0;border-bottom:1px solid var(--line);vertical-align:baseline}
thead th{color:var(--faint);font-weight:500;font-size:14px}
.group th{padding-top:20px;font-weight:600}
td:nth-child(2){font-variant-numeric:tabular-nums;font-weight:600;white-space:nowrap}
td:nth-child(3){color:var(--faint)}
.commandss p{margin:16px 0 4px}
pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:11px 14px;margin:0;overflow-x:auto;
user-select:all}
footer{padding-top:28px;padding-bottom:48px;color:var(--faint);font-size:14px}
footer p{margin:0;max-width:80ch}
@media(max-width:760px){header,main,footer{padding-left:18px;padding-right:18px}header{padding-top:28px}
.split{grid-template-columns:1fr;gap:26px}.lead{max-width:420px}section{margin-top:22px;padding-top:26px}
.verdicts{grid-template-columns:1fr 1fr}.value{font-size:25px}svg text{font-size:17px}
.strip{grid-auto-columns:minmax(148px,1fr);overflow-x:auto;margin-left:-18px;margin-right:-18px;padding:2px 18px 6px}
.strip .wide{min-width:680px}.strip .wide:not(:only-child){min-width:260px}
thead{display:none}tr{display:grid;grid-template-columns:1fr auto;border-bottom:1px solid var(--line);padding:7px 0}
th,td{border:0;padding:0}td:nth-child(3){grid-column:1/-1;font-size:14px}.group{border:0;padding-top:18px}}
@media print{body{background:#fff}section,figure{break-inside:avoid}}
""".strip()
