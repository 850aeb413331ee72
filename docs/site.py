"""What the site needs beside MkDocs: the README as its start, docstrings as griffe expects them, formulas as MathML."""

import contextlib
import html
import re
from pathlib import Path

import griffe
from latex2mathml.converter import convert
from mkdocs.structure.pages import Page


class Docstrings(griffe.Extension):
    """Turns Sphinx's roles into links, which stay plain code where the site documents nothing by that name."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **_: object) -> None:
        """Put the adapters where they are when installed."""
        if pkg.name == "ca_reg":
            pkg.set_member("integrations", loader.load("integrations"))
        self.on_object(obj=pkg)

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Rewrite the docstring of an object."""
        if obj.docstring:
            text = re.sub(r":\w+:`(~?)([\w.]+)`", lambda role: _link(obj, *role.groups()), obj.docstring.value)
            obj.docstring.value = text.replace("\nExample:\n", "\nExamples:\n")  # griffe knows the plural alone


def _link(obj: griffe.Object, short: str, name: str) -> str:
    text = name.rpartition(".")[2] if short else name
    with contextlib.suppress(griffe.NameResolutionError):
        name = obj.resolve(name)
    return f'<autoref identifier="{name}" optional><code>{text}</code></autoref>'


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Give the start page the README up to its mark; name the pages of benchmarks, which are no part of the site."""
    if page.file.src_uri == "index.md":
        shown, rest = Path("README.md").read_text("utf-8").split("<!-- the site ends here -->")
        for name, target in re.findall(r"^\[([\w-]+)\]: (.*)", rest, re.MULTILINE):
            target = target.removeprefix("docs/").replace("CHANGELOG", "changelog")
            shown = shown.replace(f"][{name}]", f"]({target})")
        markdown += shown.replace("](benchmarks/", "](../benchmarks/")
    return re.sub(r"\[([^\]]+)\]\(\.\./(benchmarks/[^)\s#]*)[^)\s]*\)", _named, markdown)


def _named(link: re.Match[str]) -> str:
    """Return the words of a link and the file that it leads to in a checkout."""
    text, file = link.groups()
    return f"`{file}`" if file in text else f"{text} (`{file}`)"


def on_page_content(content: str, **_: object) -> str:
    r"""Replace the \(...\) and \[...\] that pymdownx.arithmatex has marked."""
    return re.sub(r'<(\w+) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', _mathml, content, flags=re.DOTALL)


def _mathml(formula: re.Match[str]) -> str:
    _, bracket, tex = formula.groups()
    for unknown, known in (("aligned}", "align*}"), (r"\mathrm{E}", r"\operatorname{E}")):  # to latex2mathml 3.81
        tex = tex.replace(unknown, known)
    return convert(html.unescape(tex), display="block" if bracket == "[" else "inline")
