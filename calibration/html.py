"""A small helper for self-contained HTML reports: sections of figures, tiles and tables; pictures inside the
file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Tone = Literal["plain", "good", "warn"]

_STYLE = """
:root { --paper:#f6f7f9; --card:#fff; --ink:#1b2130; --soft:#667085; --line:#e4e7ec;
  --accent:#3457d5; --second:#e0762a; --good:#1a8a5a; --warn:#c4401c; color-scheme:light dark }
@media (prefers-color-scheme:dark) { :root { --paper:#11141a; --card:#191d26; --ink:#e8ebf2;
  --soft:#98a2b3; --line:#2b3140; --accent:#7d9bff; --second:#f0a05a; --good:#4cc38a; --warn:#ff8563 } }
* { box-sizing:border-box }
body { margin:0; background:var(--paper); color:var(--ink);
  font:15px/1.55 system-ui,-apple-system,"Segoe UI",Inter,Roboto,"DejaVu Sans",sans-serif }
main { max-width:1120px; margin:0 auto; padding:48px 24px 80px }
header h1 { font-size:30px; line-height:1.2; margin:0 0 6px; letter-spacing:-.02em }
header p { color:var(--soft); margin:0 }
section { margin-top:44px }
h2 { font-size:20px; letter-spacing:-.01em; margin:0 0 4px }
.lead { color:var(--soft); margin:0 0 16px; max-width:75ch }
.between { margin:16px 0 0 }
.grid { display:grid; grid-template-columns:repeat(12,1fr); gap:16px }
figure,.tiles>div,.scroll { background:var(--card); border:1px solid var(--line); border-radius:12px }
figure { margin:0; padding:14px 14px 12px; display:flex; flex-direction:column }
figure svg,figure img { display:block; width:100%; height:auto; border-radius:6px; margin:auto 0 }
figcaption { color:var(--soft); font-size:13px; margin-top:10px; line-height:1.45 }
.w4 { grid-column:span 4 }
.w5 { grid-column:span 5 }
.w6 { grid-column:span 6 }
.w7 { grid-column:span 7 }
.w8 { grid-column:span 8 }
.w12 { grid-column:span 12 }
.tiles { display:grid; grid-template-columns:repeat(var(--n),1fr); gap:12px; margin-top:16px }
.tiles>div { padding:13px 16px }
.tiles b { display:block; font-size:21px; font-weight:650; letter-spacing:-.01em; white-space:nowrap;
  font-variant-numeric:tabular-nums }
.tiles span { color:var(--soft); font-size:13px; display:block }
.good b { color:var(--good) }
.warn b { color:var(--warn) }
.scroll { margin-top:16px; overflow-x:auto }
table { border-collapse:collapse; width:100%; font-variant-numeric:tabular-nums; font-size:14px }
th,td { text-align:left; padding:8px 16px; border-top:1px solid var(--line); white-space:nowrap }
thead th { border-top:0; color:var(--soft); font-weight:500; font-size:13px }
.note { border-left:3px solid var(--warn); padding:8px 14px; margin:14px 0; background:var(--card);
  border-radius:0 8px 8px 0 }
footer { margin-top:56px; color:var(--soft); font-size:13px }
svg text { fill:var(--soft); stroke:var(--card); stroke-width:3px; paint-order:stroke;
  font:12px system-ui,"Segoe UI",Inter,Roboto,"DejaVu Sans",sans-serif }
@media (max-width:820px) {
  .w4,.w5,.w6,.w7,.w8 { grid-column:span 12 }
  .tiles { grid-template-columns:repeat(2,1fr) }
}
@media print { body { background:#fff } figure,section { break-inside:avoid } }
"""


@dataclass(frozen=True)
class Tile:
    """One number worth reading at a glance: what it is, its value with unit, and a remark."""

    label: str
    value: str
    note: str = ""
    tone: Tone = "plain"


def page(title: str, subtitle: str, sections: Sequence[str], footer: str = "") -> str:
    """A whole HTML document that needs no other file."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head>'
        f"<body><main><header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></header>{''.join(sections)}"
        f"<footer>{escape(footer)}</footer></main></body></html>\n"
    )


def section(title: str, lead: str, *blocks: str) -> str:
    """A titled part of the page; ``lead`` says in a sentence or two how to read it."""
    return f'<section><h2>{escape(title)}</h2><p class="lead">{escape(lead)}</p>{"".join(blocks)}</section>'


def grid(*figures: str) -> str:
    """Figures side by side, in columns of their own width."""
    return f'<div class="grid">{"".join(figures)}</div>'


def figure(content: str, caption: str, columns: Literal[4, 5, 6, 7, 8, 12] = 6) -> str:
    """A picture (SVG or <img> text) with its caption, so many of 12 columns wide."""
    return f'<figure class="w{columns}">{content}<figcaption>{escape(caption)}</figcaption></figure>'


def tiles(*items: Tile) -> str:
    """Numbers in a row."""
    cells = (
        f'<div class="{t.tone}"><span>{escape(t.label)}</span><b>{escape(t.value)}</b>'
        f"<span>{escape(t.note)}</span></div>"
        for t in items
    )
    columns = len(items) if len(items) <= 5 else -(-len(items) // 2)
    return f'<div class="tiles" style="--n:{columns}">{"".join(cells)}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain table of texts."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def links(pages: Mapping[str, str]) -> str:
    """A line of links: the text of each, and the address relative to this page."""
    anchors = (f'<a href="{escape(address)}">{escape(text)}</a>' for text, address in pages.items())
    return f"<p>{' · '.join(anchors)}</p>"


def lead(text: str) -> str:
    """A sentence between blocks."""
    return f'<p class="lead between">{escape(text)}</p>'


def note(text: str) -> str:
    """A remark the reader must not miss."""
    return f'<p class="note">{escape(text)}</p>'


def data_uri(image: NDArray[np.uint8]) -> str:
    """A picture (H, W) grey or (H, W, 3) RGB as the text of a data: address."""
    kind, options = (".png", []) if image.nbytes < 300_000 else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(kind, stored, options)
    mime = "image/png" if kind == ".png" else "image/jpeg"
    return f"data:{mime};base64,{base64.b64encode(encoded.tobytes()).decode()}"


def picture(image: NDArray[np.uint8], alt: str) -> str:
    """An <img> with the picture inside: (H, W) grey or (H, W, 3) RGB."""
    return f'<img alt="{escape(alt)}" src="{data_uri(image)}">'
