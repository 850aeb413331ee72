"""The documented errors stay whatever turns assertions and kornia's checks off."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ERRORS = """
import tempfile, torch, ca_reg
from ca_reg import CAMonitor, CAPenalty, CAScore
from ca_reg import Chain, GaussianDropout, OpacityNoise, Params, expected_opacity, scale_opacity
from ca_reg import functional as F
from ca_reg.functional import Multiplier

half = torch.full((5,), 0.5)
wide = torch.full((3, 4), 0.5)
dropout, noise = GaussianDropout(0.2), OpacityNoise(0.3)
FOLDER = tempfile.mkdtemp()
score = CAScore(lambda opacity, view: (opacity.flatten()[:3, None, None].expand(3, 4, 4), torch.ones(4, 4)))
CASES = {
    "dropout of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: dropout(wide)),
    "dropout of a scalar": (ValueError, "shape (N,) or (N, 1)", lambda: dropout(torch.tensor(0.5))),
    "dropout of a list": (TypeError, "opacity must be a torch tensor", lambda: dropout([0.5])),
    "dropout of integers": (TypeError, "floating-point", lambda: dropout(torch.ones(3, dtype=torch.int64))),
    "dropout of logits": (ValueError, "activated", lambda: GaussianDropout(0.2)(-half)),
    "noise of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: noise(wide)),
    "a rate of 1": (ValueError, "[0, 1)", lambda: GaussianDropout(1.0)),
    "a mask of the wrong length": (ValueError, "one value per opacity", lambda: F.apply_dropout(half, half[:3] > 0)),
    "a mask that is no tensor": (TypeError, "keep must be a torch tensor", lambda: F.apply_dropout(half, [True] * 5)),
    "noise that is no tensor": (TypeError, "noise must be a torch tensor", lambda: F.apply_opacity_noise(half, 0.1)),
    "scaling of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: scale_opacity(wide, 0.2)),
    "the mean of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: expected_opacity(wide, 0.2)),
    "a chain of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: Chain(noise, dropout)(wide)),
    "a score of one render": (ValueError, "samples", lambda: CAScore(print, samples=1)),
    "a score at rate 1": (ValueError, "drop_rate", lambda: CAScore(print, drop_rate=1.0)),
    "a score of nothing": (TypeError, "callable", lambda: CAScore(None)),
    "a score without alpha": (ValueError, "alpha", lambda: CAScore(lambda o, v: torch.ones(3, 4, 4))(half, None)),
    "a depth map as alpha": (
        ValueError, "depth map",
        lambda: CAScore(lambda o, v: (torch.ones(3, 4, 4), torch.full((4, 4), 5.0)))(half, None)
    ),
    "shares of a sampled score": (ValueError, "exact", lambda: ca_reg.attribute(score, print, half, None)),
    "a penalty of -1": (ValueError, "weight", lambda: CAPenalty(print, Multiplier.dropout(0.2), weight=-1.0)),
    "a monitor of a renderer": (TypeError, "score", lambda: CAMonitor(print, FOLDER, views={"test": [1.0]})),
    "a monitor of no views": (ValueError, "views", lambda: CAMonitor(score, FOLDER, views={}, every=1)),
    "a monitor of a list": (TypeError, "views", lambda: CAMonitor(score, FOLDER, views=[1.0], every=1)),
    "a chain of numbers": (TypeError, "module", lambda: Chain(0.2)),
    "radii of another model": (ValueError, "Gaussians", lambda: (dropout(half), dropout.mask_radii(torch.ones(3)))),
    "step -1": (ValueError, "step", lambda: dropout.set_step(-1)),
    "a negative sigma": (ValueError, "sigma", lambda: OpacityNoise(-1.0)),
    "a sigma of 1e39": (ValueError, "1e+30", lambda: OpacityNoise(1e39)),
    "a negative number of masks": (ValueError, "n must", lambda: F.draw_keep_mask(-1, 0.2)),
    "a mask of rate 1": (ValueError, "[0, 1)", lambda: F.draw_keep_mask(3, 1.0)),
    "a multiplier of rate 1": (ValueError, "[0, 1)", lambda: Multiplier.dropout(1.0)),
    "an unknown name": (ValueError, "no regularizer", lambda: ca_reg.regularizers.parse("dropuot(0.2)")),
    "a negative weight": (ValueError, "negative", lambda: F.color_variance(-half, torch.ones(5, 3))),
    "a missing field": (ValueError, "needs means", lambda: ca_reg.regularizers.parse("density")(half)),
    "a batch of cameras": (
        ValueError, "(4, 4)", lambda: Params(half, torch.ones(5, 3), view_matrix=torch.eye(4).expand(4, 4, 4)).depths
    ),
    "a score of (3, 4)": (ValueError, "shape (N,) or (N, 1)", lambda: score(wide, None)),
    "a score of numpy": (TypeError, "opacity must be a torch tensor", lambda: score(half.numpy(), None)),
    "a mask for noise": (TypeError, "noise must be", lambda: F.apply_opacity_noise(half, half > 0)),
    "weights of integers": (TypeError, "weights must be", lambda: F.color_variance(half.long(), torch.ones(5, 3))),
    "colors up to 255": (TypeError, "[0, 1]", lambda: F.color_variance(half, torch.ones(5, 3).byte())),
    "four channels": (ValueError, "(..., n, 3)", lambda: F.color_variance(torch.ones(2), torch.ones(2, 4))),
    "weights in a list": (TypeError, "weights must be a torch tensor", lambda: F.color_variance([1.0], wide)),
    "colors in a list": (TypeError, "colors must be a torch tensor", lambda: F.color_variance(half, [1.0])),
    "alphas in a list": (
        TypeError, "alphas must be a torch tensor", lambda: F.pixel_moments([0.5], wide, Multiplier.dropout(0.5))
    ),
    "moments of a list": (
        TypeError, "colors must be a torch tensor", lambda: F.pixel_moments(half, [1.0], Multiplier.dropout(0.5))
    ),
    "an error of floats": (TypeError, "mean must be a torch tensor", lambda: F.expected_squared_error(0.5, half, half)),
    "an error of two shapes": (
        ValueError, "shape of mean", lambda: F.expected_absolute_error(half, half, torch.ones(4))
    ),
}
for name, (kind, words, call) in CASES.items():
    try:
        call()
    except Exception as error:
        if not (isinstance(error, kind) and words in str(error)):
            print(f"{name}: {type(error).__name__}: {error}")
    else:
        print(f"{name}: accepted")
"""


def test_every_error_is_raised(capsys):
    exec(compile(ERRORS, "errors", "exec"), {})
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_every_error_is_raised_where_others_check_nothing():
    """Without assertions and kornia's checks."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "KORNIA_CHECKS": "0"}
    done = subprocess.run([sys.executable, "-O", "-c", ERRORS], capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("", "")
