"""Small pieces of the page: paragraphs, tables, pictures inlined, and the page around them. No external resource."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

STYLE = """
:root{--ink:#1d2733;--grey:#5c6a78;--line:#d5dbe2;--paper:#1f6fb4;--ours:#2b8a6e;--wrong:#d1495b;--so:#e08a1e}
*{box-sizing:border-box}
body{margin:0;color:var(--ink);background:#fff;font:16px/1.6 system-ui,"Segoe UI",Helvetica,Arial,sans-serif}
main{max-width:1060px;margin:0 auto;padding:2.5rem 1.5rem 5rem}
h1{font-size:2rem;line-height:1.2;margin:0 0 .4rem}
h2{font-size:1.45rem;margin:3.4rem 0 .6rem;padding-top:.8rem;border-top:2px solid var(--ink)}
h3{font-size:1.1rem;margin:2rem 0 .4rem}
p{margin:.6rem 0}
.lead{color:var(--grey);font-size:1.05rem}
nav{columns:2;margin:1.4rem 0;font-size:.95rem}
nav a{display:block;color:var(--paper);text-decoration:none;padding:.1rem 0}
.note{border-left:5px solid var(--line);padding:.15rem 0 .15rem 1rem;margin:.9rem 0}
.note b:first-child{display:block;font-size:.78rem;letter-spacing:.06em;text-transform:uppercase}
.says{border-color:var(--paper)}.says b:first-child{color:var(--paper)}
.ours{border-color:var(--ours)}.ours b:first-child{color:var(--ours)}
.wrong{border-color:var(--wrong)}.wrong b:first-child{color:var(--wrong)}
.so{border-color:var(--so)}.so b:first-child{color:var(--so)}
figure{margin:1.4rem 0}
figure img{width:100%;height:auto;display:block}
iframe{width:100%;height:980px;border:1px solid var(--line);border-radius:.5rem;margin:1rem 0}
figcaption{font-size:.9rem;color:var(--grey);margin-top:.3rem}
table{border-collapse:collapse;margin:1rem 0;font-size:.93rem;font-variant-numeric:tabular-nums}
th,td{padding:.3rem .75rem;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
th:first-child,td:first-child{text-align:left}
thead th{border-bottom:2px solid var(--ink);text-align:right}
thead th:first-child{text-align:left}
caption{text-align:left;font-weight:600;padding:.3rem 0}
.scroll{overflow-x:auto}
.words td,.words thead th{text-align:left}
td.bad{color:var(--wrong);font-weight:600}
td.good{color:var(--ours)}
.eq{font-family:"STIX Two Math","Cambria Math",Georgia,serif;background:#f6f8fa;padding:.5rem 1rem;
margin:.7rem 0;overflow-x:auto}
.big{display:flex;flex-wrap:wrap;gap:1rem;margin:1.4rem 0}
.big div{flex:1 1 200px;border:1px solid var(--line);border-radius:.5rem;padding:.8rem 1rem}
.big strong{display:block;font-size:1.5rem;line-height:1.25}
.big span{font-size:.88rem;color:var(--grey)}
@media print{h2{break-before:page}figure,table{break-inside:avoid}}
"""

SAYS, OURS, WRONG, SO = "says", "ours", "wrong", "so"
TITLES = {
    SAYS: "what the paper says", OURS: "what we computed", WRONG: "where it does not hold", SO: "what follows"
}  # fmt: skip


def p(text: str, kind: str = "") -> str:
    """A paragraph; `text` is HTML."""
    return f'<p class="{kind}">{text}</p>' if kind else f"<p>{text}</p>"


def note(kind: str, text: str) -> str:
    """A paragraph of one of the four kinds: what the paper says, what we computed, where it is wrong, what follows."""
    return f'<div class="note {kind}"><b>{TITLES[kind]}</b>{text}</div>'


def equation(text: str) -> str:
    """A displayed formula."""
    return f'<div class="eq">{text}</div>'


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], *, words: bool = False) -> str:
    """A table; cells are HTML, a cell that begins with "!" is marked bad, with "~" good; words stand to the left."""
    columns = "".join(f"<th>{cell}</th>" for cell in head)
    lines = []
    for row in rows:
        cells = []
        for cell in row:
            mark = {"!": ' class="bad"', "~": ' class="good"'}.get(cell[:1], "")
            cells.append(f"<td{mark}>{cell[1:] if mark else cell}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    kind = ' class="words"' if words else ""
    return (
        f'<div class="scroll"><table{kind}><caption>{caption}</caption><thead><tr>{columns}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def figure(file: Path, caption: str) -> str:
    """A picture (SVG) inlined, with its caption as alternative text too."""
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    plain = escape(caption.replace("<sub>", "_").replace("</sub>", ""), quote=True)
    return (
        f'<figure id="{file.stem}"><img alt="{plain}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def embedded(name: str, page: str, title: str) -> str:
    """A whole page within this one, which keeps to itself."""
    return f'<iframe id="{name}" title="{escape(title, quote=True)}" srcdoc="{escape(page, quote=True)}"></iframe>'


def number(value: float | None, digits: int = 3) -> str:
    """A figure for people; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}g}"


def page(title: str, lead: str, sections: Sequence[tuple[str, str, str]]) -> str:
    """The whole page from sections (anchor, heading, HTML)."""
    links = "".join(f'<a href="#{anchor}">{heading}</a>' for anchor, heading, _ in sections)
    body = "".join(f'<h2 id="{anchor}">{heading}</h2>{content}' for anchor, heading, content in sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>"
        f"<body><main><h1>{title}</h1>{p(lead, 'lead')}<nav>{links}</nav>{body}</main></body></html>\n"
    )
