"""splatfacto-ca without nerfstudio: what it changes in a model, and that it never breaks an ns-train."""

import subprocess
import sys
import threading
import types
from importlib.metadata import EntryPoint

import pytest
import torch
from stand_ins.gsplat import rasterization_1_4 as rasterization
from torch import nn

from ca_reg import CAScore, GaussianDropout, integrations
from ca_reg.integrations import _splatfacto, nerfstudio
from ca_reg.integrations.gsplat import regularized

N = 60
ENTRY_POINT = "ca_reg.integrations.nerfstudio:splatfacto_ca"


class Splatfacto(nn.Module):
    """As much of nerfstudio's model as the shim touches."""

    def __init__(self, config, holder):
        super().__init__()
        self.config, self.crop_box, self.plain_holder, self.step = config, None, holder, 0
        self.populate_modules()

    def populate_modules(self):
        generator = torch.Generator().manual_seed(0)
        self.means = nn.Parameter(torch.rand(N, 3, generator=generator) + torch.tensor([-0.5, -0.5, 1.5]))
        self.opacities = nn.Parameter(torch.randn(N, 1, generator=generator) + 3)
        self.colors = nn.Parameter(torch.rand(N, 3, generator=generator))

    def get_outputs(self, camera):
        image, alpha, self.info = self.plain_holder.rasterization(
            means=self.means,
            quats=torch.tensor([[1.0, 0, 0, 0]]).expand(N, 4),
            scales=torch.full((N, 3), 0.2),
            opacities=torch.sigmoid(self.opacities).squeeze(-1),
            colors=self.colors,
            viewmats=camera,
            Ks=torch.tensor([[[30.0, 0, 12], [0, 30, 10], [0, 0, 1]]]),
            width=24,
            height=20,
            packed=False,
        )
        return {"rgb": image.squeeze(0), "accumulation": alpha.squeeze(0)}

    def get_loss_dict(self, outputs, batch, metrics_dict=None):
        return {"main_loss": torch.zeros(())}

    def get_gt_img(self, image):
        return image

    def composite_with_background(self, image, background):
        return image

    def update_to_step(self, step):
        pass

    def get_image_metrics_and_images(self, outputs, batch):
        return {"psnr": 20.0}, {"img": outputs["rgb"]}


CAMERA = torch.eye(4)[None]
CONFIG = {
    "dropout": 0.4, "opacity_noise": 0.0, "opacity_decay": 1.0, "warmup_length": 500, "regularizer": "",
    "ca_samples": 5, "smooth_depth": 0.0, "output_depth_during_training": False,
}  # fmt: skip


def make(**changes):
    """A model with the shim and one without, of the same parameters and by the same module-level name."""
    module = types.ModuleType("holder")
    module.rasterization = rasterization

    class SplatfactoCA(_splatfacto.CoAdaptation, Splatfacto):
        holder = module

    config = types.SimpleNamespace(**CONFIG | changes)
    return SplatfactoCA(config, module), Splatfacto(config, module)


def activated(model):
    return torch.sigmoid(model.opacities.detach()).squeeze(-1)


def logits_of(opacity):
    """Logits that give these opacities; -inf gives 0."""
    return torch.logit(opacity)[:, None]


def test_training_drops_gaussians_from_image_gradients_and_radii():
    model, plain = make()
    torch.manual_seed(3)
    outputs = model.get_outputs(CAMERA)
    keep = model.info["radii"][0] > 0
    assert 0 < keep.sum() < N
    with torch.no_grad():
        plain.opacities.masked_fill_(~keep[:, None], -torch.inf)
    removed = plain.get_outputs(CAMERA)
    assert torch.equal(outputs["rgb"], removed["rgb"])
    assert torch.equal(outputs["accumulation"], removed["accumulation"])
    for out, info in ((outputs, model.info), (removed, plain.info)):
        info["means2d"].retain_grad()
        (out["rgb"] - 0.3).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter.grad[keep], plain.get_parameter(name).grad[keep])
        assert not parameter.grad[~keep].any()
    assert torch.equal(model.info["means2d"].grad, plain.info["means2d"].grad)


def test_every_training_step_draws_anew_at_the_rate():
    model, _ = make()
    torch.manual_seed(0)
    kept = torch.stack([(model.get_outputs(CAMERA), model.info["radii"][0] > 0)[1] for _ in range(60)])
    # 3,600 draws at 0.6: standard deviation 0.0082; five of them fail one run in 1.7 million.
    assert kept.double().mean() == pytest.approx(0.6, abs=0.041)
    assert len({tuple(row.tolist()) for row in kept}) == 60


def test_opacities_decay_from_the_step_on_at_which_density_control_begins():
    model, _ = make(opacity_decay=0.9, warmup_length=3)
    before = activated(model)
    for step in range(5):  # nerfstudio's first step is 0: three before density control, two after
        model.decay_opacities(step)
    torch.testing.assert_close(activated(model), before * 0.9**2)


def test_smooth_depth_is_the_slope_of_the_inverse_depth_over_its_mean():
    """In training, once density control has begun; before one color, where no edge of the photograph allows a jump."""
    model, _ = make(smooth_depth=0.1, warmup_length=3)
    assert model.config.output_depth_during_training
    inverse = torch.arange(4.0).expand(2, 4)[..., None]  # 0, where nothing is rendered, to 3
    depth = torch.where(inverse > 0, 1 / inverse, 1.0)
    outputs = {"depth": depth, "accumulation": (inverse > 0) * 0.7, "background": None}
    batch = {"image": torch.full((2, 4, 3), 0.5)}
    losses = []
    for model.step in range(5):
        losses.append(model.get_loss_dict(outputs, batch))
    assert ["smooth_depth" in of for of in losses] == [False, False, False, True, True]
    assert losses[-1]["smooth_depth"].item() == pytest.approx(0.1 * 1.0 / 1.5)
    assert set(model.eval().get_loss_dict(outputs, batch)) == {"main_loss"}
    with pytest.raises(ValueError, match="smooth_depth"):
        make(smooth_depth=-0.1)


def test_the_launchers_regularizer_beside_its_own_is_refused():
    model, _ = make()
    model.holder.rasterization = regularized(model.holder.rasterization.original, GaussianDropout(0.2))
    with pytest.raises(ValueError, match="leave out --dropout"):
        type(model)(model.config, model.holder)


def test_evaluation_scales_the_opacities_and_masks_nothing():
    model, plain = make()
    outputs = model.eval().get_outputs(CAMERA)
    with torch.no_grad():
        plain.opacities.copy_(logits_of(0.6 * activated(model)))
    torch.testing.assert_close(outputs["rgb"], plain.get_outputs(CAMERA)["rgb"])
    assert (model.info["radii"] > 0).all()


def test_noise_is_added_in_training_and_scaled_on_request():
    model, plain = make(dropout=0.0, opacity_noise=0.8)
    torch.manual_seed(0)
    assert not torch.equal(model.get_outputs(CAMERA)["rgb"], plain.get_outputs(CAMERA)["rgb"])
    assert torch.equal(model.eval().get_outputs(CAMERA)["rgb"], plain.get_outputs(CAMERA)["rgb"])
    scaled, _ = make(regularizer="noise(0.8, scale=True)")
    assert not torch.equal(scaled.eval().get_outputs(CAMERA)["rgb"], plain.get_outputs(CAMERA)["rgb"])


def test_other_models_of_the_module_are_left_alone_even_in_other_threads():
    model, plain = make()
    expected = plain.get_outputs(CAMERA)["rgb"]
    inside, done = threading.Event(), threading.Event()
    member = next(iter(model._regularized.chain))
    draw = member.draw

    def wait(x, generator):
        inside.set()
        assert done.wait(timeout=180)
        return draw(x, generator)

    member.draw = wait
    thread = threading.Thread(target=model.get_outputs, args=(CAMERA,))
    thread.start()
    assert inside.wait(timeout=180)
    rendered = plain.get_outputs(CAMERA)["rgb"]  # while the other thread is in the middle of a training render
    done.set()
    thread.join()
    assert torch.equal(rendered, expected)


def test_an_interrupted_render_leaves_nothing_behind():
    model, plain = make()
    expected = plain.get_outputs(CAMERA)["rgb"]
    with pytest.raises(ValueError, match="world_to_camera"):
        model.get_outputs(CAMERA * torch.nan)
    assert torch.equal(plain.get_outputs(CAMERA)["rgb"], expected)


def test_checkpoints_are_splatfactos_own():
    model, plain = make()
    model.load_state_dict(plain.state_dict())
    plain.load_state_dict(model.state_dict())


def test_a_second_model_is_not_regularized_twice():
    model, _ = make()
    again = type(model)(model.config, model.holder)
    again.eval()
    model.eval()
    assert torch.equal(again.get_outputs(CAMERA)["rgb"], model.get_outputs(CAMERA)["rgb"])


def test_evaluation_images_are_scored_at_the_opacities_as_trained():
    model, plain = make()
    outputs = model.eval().get_outputs(CAMERA)
    metrics, images = model.get_image_metrics_and_images(outputs, {"image_idx": 3})

    def render_fn(opacity, view):
        with torch.no_grad():
            plain.opacities.copy_(logits_of(opacity))
        out = plain.get_outputs(view)
        return out["rgb"].permute(2, 0, 1), out["accumulation"].squeeze(-1)

    expected = CAScore(render_fn, drop_rate=1 - 0.6 / 2)(activated(model), CAMERA, index=3)
    assert metrics["ca"] == pytest.approx(expected.value, rel=1e-4)  # logits and back: float32
    assert metrics["ca_std_error"] == pytest.approx(expected.std_error, rel=1e-4)
    assert metrics["ca_visible"] == expected.visible.double().mean()
    assert 0 < metrics["ca_visible"] < 1
    assert metrics["psnr"] == 20.0
    assert images["ca"].shape == images["img"].shape
    torch.testing.assert_close(images["ca"][..., 0].square().double(), expected.variance, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("changes", [{"ca_samples": 0}, {}])
def test_without_a_camera_or_without_samples_there_is_no_score(changes):
    model, _ = make(**changes)
    outputs = model.eval().get_outputs(CAMERA)
    if not changes:
        outputs = {name: value.clone() for name, value in outputs.items()}
    metrics, images = model.get_image_metrics_and_images(outputs, {})
    assert (set(metrics), set(images)) == ({"psnr"}, {"img"})


def test_the_settings_are_checked():
    with pytest.raises(ValueError, match="0"):
        make(dropout=1.0)


STUBS = {
    "missing": {},
    "raises anything": {"__init__": "raise RuntimeError('libcudart [/bold] was not found')"},
    "too old": {
        "__init__": "",
        "models/__init__": "",
        "models/splatfacto": "class SplatfactoModel: ...\nclass SplatfactoModelConfig: ...",
        "engine/__init__": "",
        "engine/callbacks": "TrainingCallback = TrainingCallbackLocation = None",
        "plugins/__init__": "",
        "plugins/types": "class MethodSpecification: ...",
    },
}


@pytest.fixture
def only_stub(tmp_path, monkeypatch):
    """Let `import nerfstudio` find a stub of that name, and nothing else."""

    def use(files):
        for name in [name for name in sys.modules if name.split(".")[0] == "nerfstudio"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.delitem(sys.modules, "ca_reg.integrations._splatfacto_method", raising=False)
        monkeypatch.delattr(integrations, "_splatfacto_method", raising=False)
        if not files:
            monkeypatch.setitem(sys.modules, "nerfstudio", None)
        for name, text in files.items():
            path = tmp_path / "nerfstudio" / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        monkeypatch.syspath_prepend(tmp_path)

    yield use
    for name in [name for name in sys.modules if name.split(".")[0] == "nerfstudio"]:
        del sys.modules[name]
    sys.modules.pop("ca_reg.integrations._splatfacto_method", None)


@pytest.mark.parametrize("kind", STUBS)
def test_loading_the_entry_point_never_raises(only_stub, kind):
    only_stub(STUBS[kind])
    loaded = EntryPoint("splatfacto-ca", ENTRY_POINT, "nerfstudio.method_configs").load()
    assert isinstance(loaded, nerfstudio.Unavailable)
    text = str(loaded)
    assert "nerfstudio 1.1.1 or newer" in text
    reason = {"missing": "nerfstudio", "raises anything": "libcudart", "too old": "gsplat.rendering.rasterization"}
    assert reason[kind] in text.split(": ", 1)[1]
    assert not {"[", "]"} & set(text)  # markup of rich: "[/bold]" would raise where nerfstudio prints this
    with pytest.raises(ImportError, match="SplatfactoCAModel belongs to splatfacto-ca"):
        _ = nerfstudio.SplatfactoCAModel


@pytest.mark.slow
def test_a_fresh_process_without_nerfstudio_imports_the_module():
    code = f"import importlib, sys; sys.modules['nerfstudio'] = None; sys.modules['gsplat'] = None\n\
module, name = '{ENTRY_POINT}'.split(':')\nprint(getattr(importlib.import_module(module), name))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("splatfacto-ca (which needs nerfstudio")


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'splatfacto'"):
        _ = nerfstudio.splatfacto


def test_a_users_command_takes_no_added_line(pytestconfig):
    """The package registers itself: `ns-train splatfacto-ca` instead of `ns-train splatfacto` is all."""
    lines = (pytestconfig.rootpath / "pyproject.toml").read_text().splitlines()
    place = lines.index('[project.entry-points."nerfstudio.method_configs"]')
    assert lines[place + 1] == f'splatfacto-ca = "{ENTRY_POINT}"'


def test_a_users_own_regularizer_trains_and_renders(my_module):
    model, plain = make(regularizer="my_module:MyDropout(0.8) + my_module:MyScaleNoise(0.3)")
    torch.manual_seed(0)
    image = model.get_outputs(CAMERA)["rgb"]
    dropout, noise = model._regularized.chain
    keep = dropout.keep
    assert torch.equal(model.info["radii"][0] > 0, keep)
    assert 0 < keep.sum() < N

    def literal(opacities, scales):
        arguments = {
            "means": plain.means, "quats": torch.tensor([[1.0, 0, 0, 0]]).expand(N, 4), "scales": scales,
            "opacities": opacities, "colors": plain.colors, "viewmats": CAMERA, "width": 24, "height": 20,
            "Ks": torch.tensor([[[30.0, 0, 12], [0, 30, 10], [0, 0, 1]]]),
        }  # fmt: skip
        return rasterization(**arguments)[0][0]

    scales = 0.2 * torch.exp(0.3 * noise.last.value).expand(N, 3)
    torch.testing.assert_close(image, literal(activated(plain) * keep, scales), rtol=1e-5, atol=1e-6)
    rates = 0.8 * torch.exp(-plain.means[:, 2] / 4.0)  # the camera looks along z from the origin
    expected = literal(activated(plain) * (1 - rates), torch.full((N, 3), 0.2))
    torch.testing.assert_close(model.eval().get_outputs(CAMERA)["rgb"], expected, rtol=1e-5, atol=1e-6)


def test_a_schedule_follows_the_steps_and_a_checkpoint():
    model, plain = make(regularizer="dropout(ramp(0, 0.5, 0, 10))")
    model.get_outputs(CAMERA)
    assert model.info["radii"].all()
    model.step = 10
    model.get_outputs(CAMERA)
    assert not model.info["radii"].all()
    loaded, _ = make(regularizer="dropout(ramp(0, 0.5, 0, 10))")
    loaded.update_to_step(10)
    with torch.no_grad():
        plain.opacities.copy_(logits_of(0.5 * activated(model)))
    for ours in (model, loaded):
        torch.testing.assert_close(ours.eval().get_outputs(CAMERA)["rgb"], plain.get_outputs(CAMERA)["rgb"])
