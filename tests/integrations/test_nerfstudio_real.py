"""splatfacto-ca in the real nerfstudio, as far as a CPU goes; skipped where nerfstudio is absent."""

import types
import warnings
from importlib.metadata import EntryPoint, EntryPoints

import pytest
import torch
from stand_ins.gsplat import rasterization_1_4 as rasterization
from torch import nn

from ca_reg.integrations import nerfstudio

ENTRY_POINT = "ca_reg.integrations.nerfstudio:splatfacto_ca"


@pytest.fixture
def splatfacto(monkeypatch):
    """The real module, as far as a CPU goes: by the rasterization above, without LPIPS and its downloads."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("nerfstudio.configs.method_configs", reason="needs nerfstudio", exc_type=ImportError)
    from nerfstudio.models import splatfacto

    monkeypatch.setattr(splatfacto, "rasterization", rasterization)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *_, **__: self)
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", Zero)
    with torch.compiler.set_stance("force_eager"):
        yield splatfacto


class Zero(nn.Module):
    """Stands in for a metric."""

    def __init__(self, **_):
        super().__init__()

    def forward(self, *_):
        return torch.zeros(())


def make_real(splatfacto, config, **changes):
    """A model of the real package on random points, an optimizer for it, and a camera in front of it."""
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.data.scene_box import SceneBox

    torch.manual_seed(0)
    for name, value in {"num_random": 300, "random_scale": 2.0, "num_downscales": 0, "use_absgrad": False}.items():
        setattr(config, name, value)
    for name, value in changes.items():
        setattr(config, name, value)
    model = config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=3, metadata={})
    optimizers = types.SimpleNamespace(
        optimizers={
            name: torch.optim.Adam(group, lr=1e-3) for name, group in model.get_gaussian_param_groups().items()
        },
        schedulers={},
    )
    pose = torch.eye(4)[None, :3]
    pose[..., 2, 3] = 4.0
    camera = Cameras(pose, fx=40.0, fy=40.0, cx=16.0, cy=12.0, width=32, height=24)
    return model, optimizers, camera


def train_step(model, optimizers, camera, step):
    model.step_cb(optimizers, step)
    batch = {"image": torch.full((24, 32, 3), 0.5), "image_idx": 0}
    outputs = model.get_outputs(camera)
    sum(model.get_loss_dict(outputs, batch).values()).backward()
    model.step_post_backward(step)
    for optimizer in optimizers.optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    return outputs, batch


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_real_model_trains_and_counts_only_what_was_rendered(splatfacto):
    model, optimizers, camera = make_real(splatfacto, nerfstudio.SplatfactoCAModelConfig(dropout=0.4))
    assert isinstance(model, splatfacto.SplatfactoModel)
    before = model.means.detach().clone()
    seen = torch.zeros(model.num_points)
    for step in range(3):
        train_step(model, optimizers, camera, step)
        seen += model.info["radii"][0] > 0
    assert torch.equal(model.strategy_state["count"], seen)
    assert 0 < seen.mean() < 3
    assert not torch.equal(model.means, before)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_real_model_densifies_and_is_scored(splatfacto):
    config = nerfstudio.SplatfactoCAModelConfig(dropout=0.2, opacity_noise=0.3)
    schedule = {"warmup_length": 2, "refine_every": 4, "densify_grad_thresh": 1e-6, "reset_alpha_every": 1000}
    model, optimizers, camera = make_real(splatfacto, config, **schedule)
    model.gauss_params["opacities"].data.fill_(2.0)
    for step in range(15):
        train_step(model, optimizers, camera, step)
    assert model.num_points > 300
    model.eval()
    outputs = model.get_outputs_for_camera(camera)
    metrics, images = model.get_image_metrics_and_images(
        outputs, {"image": torch.full((24, 32, 3), 0.5), "image_idx": 0}
    )
    assert 0 < metrics["ca"] < 0.1
    assert 0 < metrics["ca_std_error"] < metrics["ca"]
    assert {"psnr", "ssim", "lpips", "ca_visible"} <= set(metrics)
    assert images["ca"].shape == (24, 32, 3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_real_models_depth_is_smoothed(splatfacto):
    model, optimizers, camera = make_real(splatfacto, nerfstudio.SplatfactoCAModelConfig(smooth_depth=1.0))
    batch = {"image": torch.full((24, 32, 3), 0.5), "image_idx": 0}
    for step, named in ((0, False), (model.config.warmup_length, True)):
        model.step_cb(optimizers, step)
        losses = model.get_loss_dict(model.get_outputs(camera), batch)
        assert ("smooth_depth" in losses) == named
    losses["smooth_depth"].backward()
    assert 0 < losses["smooth_depth"] < 10
    assert model.means.grad[:, 2].any()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_without_rates_the_real_model_is_splatfacto(splatfacto):
    runs = []
    for config in (nerfstudio.SplatfactoCAModelConfig(dropout=0.0, ca_samples=0), splatfacto.SplatfactoModelConfig()):
        model, optimizers, camera = make_real(splatfacto, config)
        for step in range(2):
            outputs, _ = train_step(model, optimizers, camera, step)
        runs.append((model, outputs))
    (ours, image), (plain, expected) = runs
    assert torch.equal(image["rgb"], expected["rgb"])
    ours.load_state_dict(plain.state_dict())
    plain.load_state_dict(ours.state_dict())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_real_registry_lists_the_method_or_says_why_not(splatfacto, monkeypatch, capsys):
    import nerfstudio.plugins.registry as registry

    found = EntryPoints([EntryPoint("splatfacto-ca", ENTRY_POINT, "nerfstudio.method_configs")])
    monkeypatch.setattr(registry, "entry_points", lambda group: found)
    methods, descriptions = registry.discover_methods()
    config = methods["splatfacto-ca"]
    assert "dropout" in descriptions["splatfacto-ca"]
    assert isinstance(config.pipeline.model, nerfstudio.SplatfactoCAModelConfig)
    loaded = yaml_round_trip(config)
    assert loaded.pipeline.model._target is nerfstudio.SplatfactoCAModel
    monkeypatch.setattr(
        nerfstudio, "splatfacto_ca", nerfstudio.Unavailable(OSError("no [/red] libcudart")), raising=False
    )
    methods, _ = registry.discover_methods()
    assert "splatfacto-ca" not in methods
    assert "libcudart" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_real_callbacks_decay_opacities_after_the_step_they_are_told_of(splatfacto):
    from nerfstudio.engine.callbacks import TrainingCallbackLocation

    config = nerfstudio.SplatfactoCAModelConfig(opacity_decay=0.5)
    model, optimizers, camera = make_real(splatfacto, config, warmup_length=2)
    callbacks = model.get_training_callbacks(types.SimpleNamespace(optimizers=optimizers))
    for step in range(3):
        train_step(model, optimizers, camera, step)
        before = model.opacities.detach().sigmoid()
        for callback in callbacks[2:]:  # splatfacto's own are what train_step does
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        torch.testing.assert_close(model.opacities.detach().sigmoid(), before * (0.5 if step == 2 else 1))


def yaml_round_trip(config):
    """The config as a saved run brings it back."""
    import yaml

    return yaml.load(yaml.dump(config), Loader=yaml.Loader)
