"""The public surface, and what importing the package costs."""

import re
import subprocess
import sys
from pathlib import Path

import ca_reg

EXPECTED = {
    "CAAttribution",
    "CAMonitor",
    "CAPenalty",
    "CAResult",
    "CAScore",
    "CASummary",
    "CATotalEffects",
    "ColorVariance",
    "Constant",
    "GaussianDropout",
    "LinearRamp",
    "ListMoments",
    "MomentsFn",
    "OpacityNoise",
    "PixelLists",
    "Reason",
    "RenderFn",
    "Rendering",
    "Schedule",
    "SharesFn",
    "StartStop",
    "__version__",
    "attribute",
    "color_variance",
    "functional",
    "scale_opacity",
    "summarize",
    "total_effects",
}


def test_the_public_names_are_these():
    assert set(ca_reg.__all__) == EXPECTED
    assert all(hasattr(ca_reg, name) for name in EXPECTED)


def test_the_version_is_that_of_the_project_file():
    project = Path(ca_reg.__file__).parents[1] / "pyproject.toml"
    assert re.search(r'^version = "(.+)"$', project.read_text(), re.MULTILINE)[1] == ca_reg.__version__


def test_importing_loads_no_optional_or_heavy_package():
    code = (
        "import sys, torch; before = set(sys.modules); import ca_reg, ca_reg.dynamics; "
        "new = {name.split('.')[0] for name in set(sys.modules) - before}; "
        "print(*sorted(new & {'kornia', 'matplotlib', 'tensorboard', 'PIL', 'reference_trainer', 'tyro', 'tqdm'}))"
    )
    root = str(Path(ca_reg.__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == ""
