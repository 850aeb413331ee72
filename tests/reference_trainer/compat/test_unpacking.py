"""The names that results are assigned to, in the forms in which repositories take them apart."""

import importlib.util
import types

import pytest

from reference_trainer.compat.outputs import names_of_results


@pytest.mark.parametrize(
    ("body", "names"),
    [
        ("image, radii = function(x)", ("image", "radii")),
        ("(image, radii, depth) = function(\n        first=x,\n        second=x)", ("image", "radii", "depth")),
        ("out, second = {}, 0\n    out['depth'], second = function(x)", ("out['depth']", "second")),
        ("result = function(x)\n    image, radii = result", ("image", "radii")),
        ("image = function(x)[0]", ("0",)),
        ("y = abs(function(x)[2])", ("0", "1", "2")),
        ("result = function(x)", None),
        ("image, *rest = function(x)", None),
        ("image = function(x)[-1]", None),
        ("function(x)", None),
        ("image = [function(x) for _ in range(1)]", None),
        ("if x:\n        image, radii = function(x)\n    else:\n        a, b, c = function(x)", ("image", "radii")),
    ],
)
def test_the_names_are_those_of_the_assignment(tmp_path, body, names):
    """The function returns its names five times over, so that they fit any number of targets."""
    found = []

    def function(first, second=None):
        found.append(names_of_results())
        return range(2 + body.count("depth)") + body.count("[2]"))

    path = tmp_path / "renderer.py"
    path.write_text(f"def render(function, x):\n    {body}\n\ndef other(result):\n    a, b, c, d = result\n")
    spec = importlib.util.spec_from_file_location("renderer", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    # The function would be the caller, being none of the packages between: it says that it is one.
    own = types.FunctionType(
        function.__code__, {"__name__": "reference_trainer.compat.test", **{"names_of_results": names_of_results}},
        "function", function.__defaults__, function.__closure__,
    )  # fmt: skip
    module.render(own, 1)
    assert found == [names]
