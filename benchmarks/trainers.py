"""Command lines of trainers of one scene: this package's, and those of repositories in folders of their names.

``{forks}`` is where these lie, ``{fork_scene}`` what `fork_scene.write_scene` writes, ``{both}`` a COLMAP folder with
the test photographs as well, as every second one by name, ``{n}`` the iterations, of which ``{half}`` and the like are
parts, and ``{option}`` what the launcher is told.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["EVALUATE", "EXPORT", "OPTIONS", "TRAINERS", "named", "settings", "steps"]

_NEVER = 10**6
_LAUNCHED = "ca_reg.integrations.run --cpu --seed {seed} {option} "
_OURS = "reference_trainer.cli train --path {scene} --images {images} --out {out} --iterations {n} --monitor-every 0 "
_FORK = (
    f"-s {{fork_scene}} -m {{out}} -r 1 --images images --iterations {{n}} --position_lr_max_steps {{n}} "
    f"--save_iterations {{n}} --test_iterations {_NEVER} --port 0 --densify_from_iter {{third}} "
    "--densification_interval {sixth} "
)

_FORKS = {  # and the options of each
    "Co-Adaptation-of-3DGS": "--n_views 3 --shift_cam_start {two_thirds} --dropout_factor 0",
    "Binocular3DGS": "--n_views 3 --shift_cam_start {two_thirds}",
    "AbsGS": "",
    "MVGS": "--mv 2",
    "DropGaussian": "--n_views 3",
    "CoR-GS": "--n_views 3 --gaussiansN 2 --coreg",
    "FSGS": "--n_views 3",
    "gaussian-splatting": "",
    "3dgs-mcmc": "--init_type sfm --cap_max 20000",
    "taming-3dgs": "--densify_until_iter {n} --percent_dense 0.07 --budget 2 --mode multiplier --cams 3",
    "LightGaussian": f"--prune_iterations {_NEVER}",  # its pruning counts Gaussians, which is refused by name
    "InstantSplat": "--n_views 3",
    "mip-splatting": "",
    "RaDe-GS": "",
}
# Each with its own settings, but for where densification begins, and what would leave the coordinates of the scene.
TRAINERS = {
    "ca-reg": f"{_OURS}--densify-from 100 --densify-gradient 0.0002 --seed {{seed}} {{option}}",
    "3DGS": f"{_LAUNCHED}{{forks}}/3DGS/train.py -s {{fork_scene}} -m {{out}} --iterations {{n}} "
    "--densify_from_iter 100 --test_iterations -1 --disable_viewer",
    "gsplat": f"{_LAUNCHED}{{forks}}/gsplat/examples/simple_trainer.py default --data_dir {{both}} "
    "--data_factor 1 --test_every 2 --no-normalize-world-space --result_dir {out} --max_steps {n} "
    "--eval_steps --save_ply --ply_steps {n} --strategy.refine-start-iter 100 --disable_viewer --disable_video",
    "splatfacto": f"{_LAUNCHED}ns-train splatfacto --output-dir {{out}} "
    "--experiment-name a --timestamp b --machine.device-type cpu --max-num-iterations {n} --vis tensorboard "
    "--pipeline.model.num-downscales 0 --pipeline.model.warmup-length 100 --pipeline.model.cull-alpha-thresh 0.005 "
    "--pipeline.model.background-color black --data {both} colmap --colmap-path sparse/0 --images-path images "
    "--downscale-factor 1 --eval-mode interval --eval-interval 2 --auto-scale-poses False --center-method none "
    "--orientation-method none --assume-colmap-world-coordinate-convention False",
}
TRAINERS |= {name: f"{_LAUNCHED}{{forks}}/{name}/train.py {_FORK}{options}" for name, options in _FORKS.items()}
TRAINERS["3dgs-mcmc"] = TRAINERS["3dgs-mcmc"].replace("--port 0 ", "")
TRAINERS["LightGaussian"] = TRAINERS["LightGaussian"].replace("train.py", "train_densify_prune.py")
# Those that drop Gaussians themselves.
TRAINERS["splatfacto-ca"] = TRAINERS["splatfacto"].replace("{option} ns-train splatfacto", "ns-train splatfacto-ca")
TRAINERS["Co-Adaptation-of-3DGS --dropout_factor 0.2"] = (
    TRAINERS["Co-Adaptation-of-3DGS"].replace(" {option} ", " ").replace("dropout_factor 0", "dropout_factor 0.2")
)
TRAINERS["gsplat mcmc"] = TRAINERS["gsplat"].replace(".py default", ".py mcmc")

_RESETS = (
    "--densify_until_iter {until} --opacity_reset_interval {reset}",
    "--densify-until {until} --opacity-reset-from {reset} --opacity-reset-every {reset} --prune-size-from {reset} "
    "--sh-every 1000",
)
_FSGS = "--n_views 3 --densify_until_iter {n} --densify_grad_threshold 0.0005 --prune_from_iter {third}"
_RECIPES = {
    "inria": ("3DGS", *_RESETS),
    "absgs": (
        "AbsGS",
        f"{_RESETS[0]} --opacity_reduce_interval {{quarter}}",
        f"{_RESETS[1]} --density absgrad(ceiling_every={{quarter}})",
    ),
    "mvgs": ("MVGS", f"{_RESETS[0]} --mv 3", _RESETS[1]),
    "binocular": (
        "Binocular3DGS",
        "--shift_cam_start {half}",
        "--sh-every 1000 --loss photometric+warp(between(1.0,{half}))",
    ),
    "3dgs": (
        "CoR-GS",
        f"{_FSGS} --gaussiansN 1 --onlyrgb --start_sample_pseudo {{half}}",
        "--sh-every 500 --opacity-reset-from {half_1}",
    ),
    "corgs": (
        "CoR-GS",
        f"{_FSGS} --gaussiansN 2 --coreg --coprune --random_background --start_sample_pseudo {{quarter}}",
        "--sh-every 500 --opacity-reset-from {quarter_1} --loss photometric+co_regularization(between(1.0,{quarter}))",
    ),
    "fsgs": (
        "FSGS",
        f"{_FSGS} --start_sample_pseudo {{half}} --end_sample_pseudo {{late}} --sample_pseudo_interval {_NEVER}",
        "--sh-every 500 --opacity-reset-from {half_1} --density proximity(until={n}) --depth {fork_scene}/depth:inverse"
        " --loss photometric+pearson(between(0.05,0,{late}))+pearson(between(0.001,{late}))",
    ),
}
for recipe, (fork, theirs, ours) in _RECIPES.items():  # a recipe beside the repository that it is named after
    TRAINERS[f"{recipe}: {fork}"] = f"{_LAUNCHED}{{forks}}/{fork}/train.py {_FORK}{theirs}"
    TRAINERS[f"{recipe}: recipe"] = (
        f"{_OURS}--recipe {recipe} --densify-from {{third}} --densify-every {{sixth}} --no-auto --seed {{seed}} {ours} "
        "{option}"
    )

EXPORT = "ca_reg.integrations.run --cpu ns-export gaussian-splat --load-config {config} --output-dir {out}/export"
EVALUATE = "reference_trainer.cli evaluate {ply} --scene {scene} --images {images} --out {out}/evaluation {scaled}"
OPTIONS = {"plain": "", "dropout": "--dropout 0.2", "noise": "--noise 0.8"}


def settings(trainer: str) -> Sequence[str]:
    """Return what a trainer is trained with: of OPTIONS those that the table shows."""
    if "{option}" not in TRAINERS[trainer]:
        return ["dropout"]
    if ": " in trainer:
        return ["plain"]
    return ["plain", "noise"] if trainer == "DropGaussian" else list(OPTIONS)  # which refuses a second dropout


def named(trainer: str, setting: str) -> dict[str, str]:
    """Return what a row is of."""
    return {"recipe": f"{trainer} {OPTIONS[setting]}".strip() if "{option}" in TRAINERS[trainer] else trainer}


def steps(n: int) -> dict[str, int]:
    """Return the iterations, and the parts of them at which something begins or ends."""
    parts = {"half": n // 2, "third": n // 3, "two_thirds": n * 2 // 3, "quarter": n // 4, "sixth": n // 6}
    parts |= {"reset": n * 2 // 5, "until": n * 4 // 5, "late": n * 19 // 20}
    return parts | {"n": n, "last": n - 1, "half_1": n // 2 + 1, "quarter_1": n // 4 + 1}
