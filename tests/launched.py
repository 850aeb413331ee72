"""A small code base with the layout of the INRIA family, and the launcher on it."""

import pytest

from ca_reg.integrations.run import main

__all__ = ["FILES", "draws", "launch", "seen"]

FILES = {
    "diff_gaussian_rasterization.py": """
        from stand_ins.inria import make_rasterizer

        GaussianRasterizer = make_rasterizer()
    """,
    "scene/__init__.py": "from scene.gaussian_model import GaussianModel\n",
    "scene/gaussian_model.py": """
        from stand_ins.inria import Model

        class GaussianModel(Model):
            def update_learning_rate(self, iteration):
                self.rate = 1e-3
    """,
    "gaussian_renderer/__init__.py": """
        from diff_gaussian_rasterization import GaussianRasterizer
        from stand_ins.inria import make_render

        render = make_render(GaussianRasterizer)
    """,
    "train.py": """
        import random
        import sys

        import torch
        from gaussian_renderer import render
        from scene import GaussianModel

        def training(iterations):
            gaussians = GaussianModel()
            background = torch.zeros(3)
            for iteration in range(1, iterations + 1):
                gaussians.update_learning_rate(iteration)
                package = render(gaussians.camera, gaussians, None, background)
                render(gaussians.camera, gaussians, None, background)  # a second view
                print("seen", int((package["radii"] > 0).sum()), torch.rand(1).item())
            with torch.no_grad():
                render(gaussians.camera, gaussians, None, background)

        if __name__ == "__main__":
            torch.manual_seed(0)
            print("argv", sys.argv[1:], "path", sys.path[0], "file", __file__)
            training(int(sys.argv[1]))
            if sys.argv[2:] == ["--fail"]:
                raise ValueError("a failure of their own")
            if sys.argv[2:] == ["--interrupt"]:
                raise KeyboardInterrupt
            sys.exit(3 if sys.argv[2:] == ["--exit"] else 0)
    """,
}


def launch(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(x) for x in arguments])
    return ended.value.code


def seen(out):
    return [int(line.split()[1]) for line in out.splitlines() if line.startswith("seen")]


def draws(out):
    return [line.split()[2] for line in out.splitlines() if line.startswith("seen")]
