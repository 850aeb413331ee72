import torch

from benchmarks.in_front import in_front, main
from reference_trainer.runs.run import Monitoring, model_of, run_experiment
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer


def test_what_is_behind_the_camera_is_not_in_front(tiny_scene, busy):
    model, view = model_of(Trainer(tiny_scene, busy)), tiny_scene.train[0]
    pose = torch.linalg.inv(view.camera.world_to_camera.double())
    along = torch.tensor([-1.0, 0.5, 1.5, 3.0], dtype=torch.float64)  # depths on the optical axis
    places = pose[:3, 3] + along[:, None] * pose[:3, 2]
    with torch.no_grad():
        model.gaussians.means[:4] = places.float()
    assert in_front(model, view, 2.0)[:4].tolist() == [False, True, True, False]


def test_a_run(tmp_path, capsys):
    """Without nobody both rows are equal; without all the picture is the background."""
    options = SceneOptions("synthetic", downscale=8)
    run_experiment(options, TrainConfig(iterations=5), tmp_path, monitoring=Monitoring(0))
    found = []
    for nearer in (1e-9, 1e9):
        capsys.readouterr()
        main(tmp_path, "test_0", nearer)
        found.append([line.split("|")[2:4] for line in capsys.readouterr().out.splitlines()[-2:]])
    (plain, without_nobody), (again, without_all) = found
    assert plain == without_nobody == again
    assert all(float(left) < float(score) for left, score in zip(without_all, plain, strict=True))
