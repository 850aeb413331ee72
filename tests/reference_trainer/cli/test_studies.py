"""What the commands of the studies ask of them."""

from pathlib import Path

import pytest

from reference_trainer.cli import main
from reference_trainer.studies import error_runtime as error_runtime_module
from reference_trainer.studies import gaussian_shares as shares_module
from reference_trainer.studies import study as study_module


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["attribution", "r"], ("r", None, {"split": "test", "drop_rate": 0.5})),
        (["attribution", "r", "--out", "o", "--split", "train", "--drop-rate", "0.3"],
         ("r", "o", {"split": "train", "drop_rate": 0.3})),
    ],
)  # fmt: skip
def test_attribution(arguments, expected, monkeypatch):
    asked = []

    def fake(run, out, **keywords):
        asked.append((str(run), out and str(out), keywords))

    monkeypatch.setattr(shares_module, "study_attribution", fake)
    main(["study", *arguments])
    source, out, keywords = expected
    assert asked == [(source, out, {**keywords, "device": "cpu"})]


def test_error_runtime(monkeypatch):
    declared, ran = [], []
    monkeypatch.setattr(
        error_runtime_module, "error_runtime_study", lambda runs, **keywords: declared.append((runs, keywords))
    )
    monkeypatch.setattr(study_module, "run_study", lambda study, out: ran.append(out))
    main(["study", "error-runtime", "r", "s", "--seeds", "2", "--out", "o"])
    assert declared == [((Path("r"), Path("s")), {"max_samples": 1024, "seeds": 2, "device": "cpu"})]
    assert ran == [Path("o")]
