"""The public surface, and what importing the package costs."""

import importlib
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ca_reg

EXPECTED = [
    "GaussianDropout", "OpacityNoise", "Chain", "CAScore", "CAResult", "Reason", "CAMonitor", "CAPenalty", "attribute",
    "error_map", "ErrorMap",
    "IndependentDropout", "Regularizer", "Params", "Draw", "scale_opacity", "expected_opacity", "__version__",
]  # fmt: skip
ELSEWHERE = {
    "attribution": {"CAAttribution", "CATotalEffects", "SharesFn", "attribute", "total_effects"},
    "decay": {"OpacityDecay"},
    "functional": {"ColorVariance", "Multiplier", "color_variance"},
    "lists": {"ListMoments", "PixelLists"},
    "monitor": {"LOG_NAME", "CAMonitor", "plot_dynamics", "read_dynamics"},
    "regularizer": {"Draw", "Learned", "Params", "Regularizer"},
    "result": {"CAResult", "CASettings", "CASummary", "Reason", "summarize"},
    "schedules": {"Constant", "ExponentialDecay", "LinearRamp", "Schedule", "StartStop"},
    "types": {"Layout", "MomentsFn", "RenderFn", "Rendering"},
}
FUNCTIONAL = {
    "ColorVariance",
    "Multiplier",
    "PixelMoments",
    "alpha_moments",
    "apply_dropout",
    "apply_opacity_noise",
    "color_variance",
    "expected_opacity",
    "contributions",
    "decayed_logits",
    "draw_keep_mask",
    "draw_numbers",
    "draw_opacity_noise",
    "expected_absolute_error",
    "expected_squared_error",
    "first_order_variance",
    "gaussian_dropout",
    "neutral_background",
    "opacity_noise",
    "pixel_moments",
    "scale_opacity",
}


def test_the_public_names_are_these_in_the_order_in_which_one_meets_them():
    assert ca_reg.__all__ == EXPECTED
    assert all(hasattr(ca_reg, name) for name in EXPECTED)


def test_the_pure_functions_are_these():
    assert set(ca_reg.functional.__all__) == FUNCTIONAL
    assert all(hasattr(ca_reg.functional, name) for name in FUNCTIONAL)


@pytest.mark.parametrize("module", ELSEWHERE)
def test_the_modules_hold_the_others(module):
    found = importlib.import_module(f"ca_reg.{module}")
    assert ELSEWHERE[module] <= set(found.__all__)
    assert all(hasattr(found, name) for name in found.__all__)


def test_help_begins_with_what_one_meets_first():
    text = pydoc.render_doc(ca_reg, renderer=pydoc.plaintext)
    places = [text.index(name) for name in EXPECTED[:4]]
    assert places == sorted(places)
    assert places[-1] < text.index("class ")
    page = (Path(__file__).parents[2] / "docs/api/ca_reg.md").read_text()
    assert re.findall(r"^::: ca_reg\.(\w+)$", page, re.MULTILINE) == EXPECTED[:-1]


def test_the_version_is_that_of_the_project_file():
    project = Path(ca_reg.__file__).parents[1] / "pyproject.toml"
    assert re.search(r'^version = "(.+)"$', project.read_text(), re.MULTILINE)[1] == ca_reg.__version__


def test_importing_loads_no_optional_or_heavy_package():
    code = (
        "import sys, torch; before = set(sys.modules); import ca_reg, ca_reg.monitor; "
        "new = {name.split('.')[0] for name in set(sys.modules) - before}; "
        "print(*sorted(new & {'kornia', 'matplotlib', 'tensorboard', 'PIL', 'reference_trainer', 'tyro', 'tqdm'}))"
    )
    root = str(Path(ca_reg.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == ""
