"""The public surface, and what importing the package costs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import ca_reg

EXPECTED = {
    "CAAttribution",
    "CAMonitor",
    "CAPenalty",
    "CAResult",
    "CAScore",
    "CASummary",
    "CATotalEffects",
    "Chain",
    "ColorVariance",
    "Constant",
    "Draw",
    "GaussianDropout",
    "IndependentDropout",
    "Learned",
    "LinearRamp",
    "ListMoments",
    "MomentsFn",
    "OpacityNoise",
    "Params",
    "PixelLists",
    "Reason",
    "Regularizer",
    "RenderFn",
    "Rendering",
    "Schedule",
    "SharesFn",
    "StartStop",
    "__version__",
    "attribute",
    "color_variance",
    "expected_opacity",
    "functional",
    "scale_opacity",
    "summarize",
    "total_effects",
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


@pytest.mark.parametrize(("module", "names"), [(ca_reg, EXPECTED), (ca_reg.functional, FUNCTIONAL)])
def test_the_public_names_are_these(module, names):
    assert set(module.__all__) == names
    assert all(hasattr(module, name) for name in names)


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
