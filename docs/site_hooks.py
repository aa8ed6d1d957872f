"""What the site adds to the pages: the reference, files outside docs/ that pages link to, words explained."""

from __future__ import annotations

import ast
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGES = ("litho_data", "litho_models", "litho_design")
_LINK = re.compile(r"\]\((?P<place>\.\./[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
# Words of the glossary that pages also use in their everyday sense: the glossary alone explains them.
_EVERYDAY = {"arm", "effect", "fold", "judge", "knob", "probe", "stroke"}
# A cell of more letters than this is given room, on a telephone or at the head; the table scrolls.
_LONG_CELL = 40
# Where a line would break inside a figure, outside code: 19.1 nm, (18.2 … 19.9), ± 0.2, → 15.6, 20 of 20,
# p = 0.03, 71–99 %, 1e-12.
_INSIDE_FIGURE = re.compile(
    r"<(pre|code)\b.*?</\1>|<[^>]*>|(?<=\d) (?=(?:nm|µm|mm|dB|px|ms|s|min|h|MiB|GiB|TiB)\b|[%…±]|of \d)"
    r"|(?<=[…±→=]) (?=[-−+\d])|(?<=\d of) (?=\d)|(?<=\b[kp]) (?==)|(?<=\d)–(?=\d)|(?<=\de)-(?=\d)",
    re.DOTALL,
)
_UNBROKEN = {" ": "\u00a0", "–": "–\u2060", "-": "-\u2060"}
_LANGUAGES = {".py": "python", ".toml": "toml", ".json": "json"}


def on_files(files: Files, config: Any) -> Files:
    """Add a page for the public face of every package, and one for every file outside that is linked to."""
    for package in PACKAGES:
        files.append(File.generated(config, f"reference/{package}.md", content=_reference(package)))
    outside = {
        place
        for page in files.documentation_pages()
        if page.abs_src_path
        for place in _outside(page.src_uri, Path(page.abs_src_path).read_text("utf-8"))
    }
    for place in sorted(outside):
        files.append(File.generated(config, f"files/{place}.md", content=_shown(ROOT / place)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links that leave docs/ to the pages made for them; explain the words of the glossary."""

    def inside(link: re.Match[str]) -> str:
        place = _target(page.file.src_uri, link["place"])
        if place is None:
            return link[0]
        return f"]({posixpath.relpath(f'files/{place}.md', posixpath.dirname(page.file.src_uri) or '.')})"

    text = _LINK.sub(inside, markdown)
    return text if page.file.src_uri == "glossary.md" else text + _abbreviations()


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Lines break after / and _ of a name, not in options and figures; a click on a picture shows it whole.

    Sphinx's roles in docstrings are only code here.
    """
    html = re.sub(r":(?:func|class|mod|meth|data):<code>~?", "<code>", html)
    html = re.sub(r"<(t[dh])>(.*?)</t[dh]>", _roomy, html, flags=re.DOTALL)
    html = _INSIDE_FIGURE.sub(lambda found: _UNBROKEN.get(found[0], found[0]), html)
    html = re.sub(r"<a [^>]*>\s*<img.*?</a>|<img [^>]*>", _opened, html, flags=re.DOTALL)
    return re.sub(r"<pre>.*?</pre>|(?<=<code>)[^<]+(?=</code>)", _breakable, html, flags=re.DOTALL)


def _breakable(code: re.Match[str]) -> str:
    if code[0].startswith("<pre>"):
        return code[0]
    broken = re.sub(r"(?<=\w)([/_])(?=\w)", r"\1<wbr>", code[0])
    return re.sub(r"(?<![\w-])--[a-z][a-z0-9-]*", r'<span class="option">\g<0></span>', broken)


def _roomy(cell: re.Match[str]) -> str:
    kind, content = cell.groups()
    words = re.sub(r"<[^>]+>", "", content)
    return f'<{kind} class="long">{content}</{kind}>' if len(words) > _LONG_CELL else cell[0]


def _opened(picture: re.Match[str]) -> str:
    place = re.search(r'src="([^"]+\.(?:jpg|png))"', picture[0])
    return (
        picture[0]
        if place is None or picture[0].startswith("<a ")
        else f'<a href="{place[1]}">{picture[0]}</a>'
    )


def _outside(page: str, text: str) -> set[str]:
    found = {_target(page, link["place"]) for link in _LINK.finditer(text)}
    return {place for place in found if place is not None}


def _target(page: str, link: str) -> str | None:
    """The file outside docs/ that a link of a page leads to, from the root of the checkout; else None."""
    place = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), link))
    return None if place.startswith("docs/") else place


def _shown(file: Path) -> str:
    """A file of code as a page."""
    return f"# {file.name}\n\n```{_LANGUAGES.get(file.suffix, '')}\n{file.read_text('utf-8')}\n```\n"


def _reference(package: str) -> str:
    tree = ast.parse((ROOT / package / "__init__.py").read_text("utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {alias.asname for node in imports for alias in node.names if alias.asname}
    entries = "\n".join(f"::: {package}.{name}\n" for name in sorted(names))
    return f"# {package}\n\n{ast.get_docstring(tree)}\n\n{entries}"


def _abbreviations() -> str:
    """The glossary as definitions that show where its words stand."""
    rows = re.findall(
        r"^\| ([^|]+?) \| ([^|]+?) \|", (ROOT / "docs" / "glossary.md").read_text("utf-8"), re.M
    )
    found = [
        f"*[{word}]: {re.sub(r'[`*]', '', meaning)}"
        for words, meaning in rows[1:]
        for word in words.split(", ")
        if word not in _EVERYDAY
    ]
    return "\n\n" + "\n".join(found) + "\n"
