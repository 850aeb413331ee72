"""One word means one thing: names that had a second meaning do not come back."""

import ast
from collections.abc import Iterator
from pathlib import Path

from floors import sources

BETTER = {
    "behind": "background",
    "begun_with": "settings_of_run",
    "draw_masks": "render_masks",  # to draw is to sample at random
    "drawn_by": "using_engine",
    "foreign": "outside, existing",
    "glance": "training_snapshot",
    "multiplied": "alpha_factor, factored",
    "of_ply": "load_ply_model",
    "of_run": "load_run_model",
    "picture": "image",  # people read "picture" in texts
    "place_of": "scene_or_orbit",
    "say": "a logger",
    "watch": "on_step",
    "watched": "on_step",
    "Foreign": "WrappedModule",
    "Kept": "ResultStore",  # to keep is to leave a Gaussian in
    "LEAST": "MIN_...",
    "Picture": "Display, Planes",
    "Placed": "ModelWithViews",
    "Say": "a logger",
    "Watch": "ScriptAudit",
}
"""Names that only had the meaning which is called otherwise now. A word of several meanings, such as draw, is none."""


def _names(tree: ast.AST) -> Iterator[str]:
    """The names of functions, classes, arguments, attributes and variables in a source, without underscores before."""
    for node in ast.walk(tree):
        found = [getattr(node, part, None) for part in ("name", "id", "attr", "arg", "asname")]
        if not isinstance(node, ast.alias) or node.asname:
            yield from (name.lstrip("_") for name in found if isinstance(name, str))


def test_names_of_every_kind_are_read():
    text = "import a as b\nclass C:\n    def d(self, e, *f):\n        self.g = h = self._i(j=1)\n"
    assert {"b", "C", "d", "e", "f", "g", "h", "i", "j"} <= set(_names(ast.parse(text)))


def test_words_with_a_second_meaning_stay_away():
    root, old = Path(__file__).parents[1], []
    for module, path in sources(root).items():
        names = set(_names(ast.parse(path.read_text(encoding="utf-8"))))
        old += [f"{module}: {name} is called {BETTER[name]}" for name in sorted(names & BETTER.keys())]
    assert old == []
