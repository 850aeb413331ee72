"""What the order of additions does to a gradient and to a training; CUDA leaves that order open.

Measured without a card, on the pretended one, which adds in random orders what atomic additions add on CUDA. Print the
table: ``PYTHONPATH=.:tests python tests/reliability/order.py --path scene --images images_16``.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
from collections.abc import Sequence

import torch
from stand_ins.card import CARD, pretended_card
from torch import Tensor

from reference_trainer.evaluation.metrics import psnr
from reference_trainer.evaluation.results import markdown_table
from reference_trainer.model.rendering import render_gaussians
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.losses.photometric import photometric_loss
from reference_trainer.training.trainer import Trainer

__all__ = ["gradient_differences", "gradients", "main", "trained"]


def trained(scene: Scene, config: TrainConfig, order: int | None) -> Trainer:
    """Train on the pretended card, in an order of additions or in that of the processor."""
    with pretended_card(order=order) as card:
        trainer = Trainer(scene, config, card)
        trainer.train(progress=True)
    return trainer


def gradients(trainer: Trainer) -> dict[str, Tensor]:
    """Return the gradient of the loss of the first training view."""
    view, named = trainer.views[0], dict(trainer.gaussians.named())
    image = render_gaussians(trainer.gaussians, view.camera, trainer.background).image
    found = torch.autograd.grad(photometric_loss(image, view.image), list(named.values()))
    return {name: gradient.cpu() for name, gradient in zip(named, found, strict=True)}


def gradient_differences(trainer: Trainer, orders: Sequence[int]) -> dict[str, list[float]]:
    """Return by parameter how far the gradient of each order is from that of the processor, relative in norm."""
    with pretended_card():
        plain = gradients(trainer)
    differences: dict[str, list[float]] = {name: [] for name in plain}
    for order in orders:
        with pretended_card(order=order):
            found = gradients(trainer)
        for name, x in plain.items():
            differences[name].append(((found[name] - x).norm() / x.norm()).item())
    return differences


def main() -> None:
    """Run the measurement that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--path", default="synthetic", help="scene folder")
    parser.add_argument("--images", help="image folder within the scene")
    parser.add_argument("--downscale", type=float, default=1.0, help="of the photographs")
    parser.add_argument("--iterations", type=int, default=200, help="of each training")
    parser.add_argument("--densify-every", type=int, default=25, help="steps, from step 50 on; 0 for never")
    parser.add_argument("--orders", type=int, default=3, help="how many orders of additions")
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds to compare with")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = load_scene(SceneOptions(options.path, images=options.images, downscale=options.downscale))
    config = TrainConfig(
        iterations=options.iterations, dropout=0.2, noise=0.4,
        densify_from=50, densify_every=options.densify_every,
    )  # fmt: skip
    orders, rows = range(options.orders), []

    def row(seed: int, order: int | None) -> Trainer:
        trainer = trained(scene, dataclasses.replace(config, seed=seed), order)
        named = "the processor's" if order is None else order
        rows.append({"seed": seed, "order": named, "test PSNR": quality(trainer), "Gaussians": len(trainer.gaussians)})
        print(rows[-1], flush=True)
        return trainer

    first = row(0, None)
    for name, found in gradient_differences(first, orders).items():
        print(f"gradient of {name}: {statistics.fmean(found):.1e}, at most {max(found):.1e}", flush=True)
    for order in orders:
        row(0, order)
    for seed in range(1, options.seeds):
        row(seed, None)
    print(markdown_table(rows, list(rows[0])))


def quality(trainer: Trainer) -> float:
    """Return the mean PSNR of the test views."""
    with pretended_card(), torch.no_grad():
        model, ground = trainer.gaussians, trainer.background
        views = [view.to(torch.device(CARD)) for view in trainer.scene.test]
        images = [render_gaussians(model, view.camera, ground).image for view in views]
        return statistics.fmean(psnr(image.cpu(), view.image.cpu()) for image, view in zip(images, views, strict=True))


if __name__ == "__main__":
    main()
