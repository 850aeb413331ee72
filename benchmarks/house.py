"""How large the code and its pages are, and whether it has floors: ``python -m benchmarks.house [ROOT]``.

Prints one table for the packages that are installed, one of how densely each of their folders is commented, and one for
the whole; then a circle of imports, if there is one, and every import of a higher floor. With ``--walk`` it prints
instead what a stranger opens and reads, see house.md; with ``--tests`` how often the tests pin wording and private
names.
"""

from __future__ import annotations

import argparse
import ast
import io
import math
import re
import statistics
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

from reference_trainer.evaluation.tables import markdown_table
from tests.floors import circle, import_graph, sources, upward

__all__ = ["PINNED", "WALKS", "comments_and_code", "main", "pinned", "tests", "walked"]

PRAGMA = re.compile(r"(\s*#\s*(fmt: \w+|noqa(: [A-Z]+\d+(, ?[A-Z]+\d+)*)?|type: ignore(\[[\w, -]+\])?))+")
"""What a comment for the linters looks like; one that goes on to give its reason is a comment for people too."""

GOALS = {"installed lines": 25_000, "lines of ca_reg": 5_000, "words in docs": 30_000, "names exported by ca_reg": 18,
         "circles of imports": 0, "imports of a higher floor": 0, "files per 1,000 lines": 6}  # fmt: skip

COMMENTS, COMMENTS_OF_ENGINES = 4, 5
"""Comments per 100 lines of code of every folder, and of the engines below ``render/``: gradients by hand need more."""

README_TO_DROPOUT = ("README.md", "## Your own code base", "from ca_reg import GaussianDropout")
README_TO_SCORE = ("README.md", "## Your own code base", "from ca_reg import CAScore")
WALKS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "the line that drops a Gaussian": (
        README_TO_DROPOUT,
        ("ca_reg/regularizers/dropout.py", "    def draw(", "functional.apply_dropout("),
        ("ca_reg/functional/opacities.py", "def apply_dropout(", "opacity.masked_fill("),
    ),
    "its test": (
        ("tests/ca_reg/test_dropout.py", "import ", "def test_scaling_is_the_mean_over_all_masks"),
    ),
    "the line that computes the variance, of renders": (
        README_TO_SCORE,
        ("ca_reg/score.py", "    def _measure(", "moments.variance(settings.ddof)"),
        ("ca_reg/_accumulate.py", "    def variance(", "scatter.clamp_("),
    ),
    "its test, over all tuples of masks": (
        ("tests/ca_reg/test_score.py", "import ", "def test_expected_value_over_all_tuples_of_masks"),
    ),
    "the line that computes the variance, exactly": (
        README_TO_SCORE,
        ("docs/theory.md", "## The recursion", "*Code:* `pixel_moments`"),
        ("ca_reg/functional/moments.py", "def _moments(", "(colors - mean[..., 1:, :]).square()"),
    ),
    "its test, by the enumeration of all masks": (
        ("tests/ca_reg/test_moments.py", "def test_dropout_equals_the_enumeration", "result.variance"),
    ),
}  # fmt: skip
"""What a stranger looks for: the files on the way, each with the text from which on and up to which it is read."""


def walked(root: Path) -> list[dict[str, object]]:
    """Return a row for each of `WALKS`: files that are opened, and lines read; ValueError if a way is lost."""
    rows: list[dict[str, object]] = []
    for goal, way in WALKS.items():
        read, places = 0, []
        for file, since, until in way:
            lines = (root / file).read_text("utf-8").splitlines()
            first = next((i for i, line in enumerate(lines) if since in line), None)
            last = next((i for i, line in enumerate(lines) if first is not None and i >= first and until in line), None)
            if first is None or last is None:
                raise ValueError(f"{file} does not go from {since!r} to {until!r} any more: find the new way there.")
            read += last - first + 1
            places.append(f"{file}:{last + 1}")
        rows.append({"from the README to": goal, "files": len(way), "lines read": read, "where": ", ".join(places)})
    return rows


PINNED = {"matches of 4 words": 62, "matches of 6 words": 7, "asserts on 5 words": 58, "reads of private names": 49,
          "imports of private names": 28, "patches of private names": 9}  # fmt: skip
"""What the tests pin that a user does not see, with the most that is allowed: lower these when the tests improve."""


def _words(node: ast.AST) -> int:
    """Count the words of a string, or pattern, and not what is quoted in it, nor names of files, options or code."""
    text = " ".join(x.value for x in ast.walk(node) if isinstance(x, ast.Constant) and isinstance(x.value, str))
    return len(re.findall(r"(?<![\w\\./'=-])[A-Za-z]+(?![\w\\/=-]|\.\w)", text))


def _private(name: str) -> bool:
    public = ("__", "_replace", "_fields", "_asdict")  # the last three are those of named tuples
    return any(part.startswith("_") and not part.startswith(public) for part in name.split("."))


def pinned(sources: Iterable[str]) -> dict[str, int]:
    """Count in the sources of tests what `PINNED` limits; a private module of another package counts too.

    Example:
        >>> pinned(['assert "one of the five words" in text', "from a import _b"])["asserts on 5 words"]
        1
    """
    counts = dict.fromkeys(PINNED, 0)
    for node in (node for source in sources for node in ast.walk(ast.parse(source))):
        match node:
            case ast.keyword(arg="match", value=text):
                counts["matches of 4 words"] += _words(text) >= 4
                counts["matches of 6 words"] += _words(text) >= 6
            case ast.Assert(test=test):
                counts["asserts on 5 words"] += any(
                    _words(x) >= 5 for x in ast.walk(test) if isinstance(x, ast.Constant | ast.JoinedStr)
                )
            case ast.Attribute(value=owner, attr=name):
                counts["reads of private names"] += _private(name) and ast.unparse(owner) != "self"
            case ast.ImportFrom(module=module, names=names):
                counts["imports of private names"] += sum(_private(f"{module}.{x.name}") for x in names)
            case ast.Call(func=ast.Attribute(attr="setattr" | "delattr" | "setitem"), args=[*args]):
                texts = [x.value for x in args[:2] if isinstance(x, ast.Constant) and isinstance(x.value, str)]
                counts["patches of private names"] += any(map(_private, texts))
    return counts


def tests(root: Path) -> list[str]:
    """Return the sources of all tests, of the product and of the evidence."""
    folders = (root / "tests", root / "benchmarks" / "tests")
    return [path.read_text("utf-8") for folder in folders for path in sorted(folder.rglob("*.py"))]


def comments_and_code(source: str) -> tuple[int, int]:
    """Return the number of lines with a comment for people and of lines with code; docstrings are neither.

    Example:
        >>> comments_and_code('"Doc."\\n# why\\nx = 1  # unit\\ny = 2  # noqa: F841\\n')
        (2, 2)
    """
    skipped = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER)
    comments, code = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments |= set() if PRAGMA.fullmatch(token.string) else {token.start[0]}
        elif token.type not in skipped:
            code |= {*range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):  # a docstring
                code -= {*range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    return len(comments), len(code)


def _density(texts: Iterable[str]) -> float:
    """Comments per 100 lines of code; infinite where there is no code that could need one."""
    comments, code = (sum(column) for column in zip(*map(comments_and_code, texts), strict=True))
    return 100 * comments / code if code else math.inf


def _row(title: str, texts: list[str]) -> dict[str, object]:
    lines = [text.count("\n") for text in texts]
    return {"": title, "lines": f"{sum(lines):,}", "files": len(lines),
            "files per 1,000 lines": f"{1000 * len(lines) / sum(lines):.1f}", "median": int(statistics.median(lines)),
            "longest": max(lines), "comments per 100 lines of code": f"{_density(texts):.1f}"}  # fmt: skip


def _tables(root: Path) -> Iterator[str]:
    found = {path.relative_to(root).as_posix(): path.read_text("utf-8") for path in sources(root).values()}
    folders = [name for name in ("ca_reg", "integrations", "reference_trainer", "reference_trainer/render", "")
               if any(file.startswith(name) for file in found)]  # fmt: skip
    rows = [_row(f"`{name}`" if name else "all that is installed",
                 [text for file, text in found.items() if file.startswith(name and f"{name}/")])
            for name in folders]  # fmt: skip
    yield markdown_table(rows, list(rows[0]))

    by_folder: dict[str, list[str]] = {}
    for file, text in found.items():
        by_folder.setdefault(file.rpartition("/")[0], []).append(text)
    commented: list[dict[str, object]] = [
        {"files of": f"`{folder}`", "comments per 100 lines of code": f"{density:.1f}",
         "goal": COMMENTS_OF_ENGINES if folder.startswith("reference_trainer/render/") else COMMENTS}
        for folder, texts in sorted(by_folder.items()) if (density := _density(texts)) < math.inf
    ]  # fmt: skip
    yield markdown_table(commented, list(commented[0]))

    graph = import_graph(root)
    round_trip, higher = circle(graph), upward(graph)
    exported = next(
        node.value for node in ast.parse(found["ca_reg/__init__.py"]).body
        if isinstance(node, ast.Assign) and any(getattr(x, "id", "") == "__all__" for x in node.targets)
    )  # fmt: skip
    lines = {file: text.count("\n") for file, text in found.items()}
    measured = {
        "installed lines": sum(lines.values()),
        "lines of ca_reg": sum(count for file, count in lines.items() if file.startswith("ca_reg/")),
        "files per 1,000 lines": round(1000 * len(found) / sum(lines.values()), 1),
        "circles of imports": int(bool(round_trip)),
        "imports of a higher floor": len(higher),
        "names exported by ca_reg": len([name for name in ast.literal_eval(exported) if not name.startswith("_")]),
        "words in docs": sum(len(page.read_text("utf-8").split()) for page in (root / "docs").rglob("*.md")),
    }
    whole: list[dict[str, object]] = [
        {"": name, "now": f"{value:,}", "goal": f"{GOALS[name]:,}"} for name, value in measured.items()
    ]
    yield markdown_table(whole, ["", "now", "goal"])
    yield f"- circle: {' -> '.join(round_trip)}\n" if round_trip else ""
    yield "".join(f"- upward: {arrow}\n" for arrow in higher)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables of a checkout."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.house", description=main.__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1], help="root of a checkout")
    parser.add_argument("--walk", action="store_true", help="what a stranger opens and reads from the README on")
    parser.add_argument("--tests", action="store_true", help="what the tests pin that a user does not see")
    options = parser.parse_args(arguments)
    if options.tests:
        rows = [{"in the tests": name, "now": count, "at most": PINNED[name]}
                for name, count in pinned(tests(options.root)).items()]  # fmt: skip
        print(markdown_table(rows, list(rows[0])), end="")
        return
    if options.walk:
        rows = walked(options.root)
        print(markdown_table(rows, list(rows[0])), end="")
        return
    print("\n".join(text for text in _tables(options.root) if text), end="")


if __name__ == "__main__":
    main()
