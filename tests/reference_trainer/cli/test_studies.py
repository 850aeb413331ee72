"""What the commands of the studies ask of them."""

from pathlib import Path

from reference_trainer.cli import main
from reference_trainer.studies import error_runtime as error_runtime_module
from reference_trainer.studies import study as study_module


def test_error_runtime(monkeypatch, tmp_path):
    declared, ran = [], []
    monkeypatch.chdir(tmp_path)
    for name in "rs":  # what a run is known by, before anything is loaded
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").touch()
    monkeypatch.setattr(
        error_runtime_module, "error_runtime_study", lambda runs, **keywords: declared.append((runs, keywords))
    )
    monkeypatch.setattr(study_module, "run_study", lambda study, out: ran.append(out))
    main(["study", "error-runtime", "r", "s", "--seeds", "2", "--out", "o"])
    assert declared == [((Path("r"), Path("s")), {"max_samples": 1024, "seeds": 2, "device": "cpu", "trust": ()})]
    assert ran == [Path("o")]
