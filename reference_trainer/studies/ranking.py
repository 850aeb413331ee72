"""The ranking study: how the variants of the CA score order the same models, and why they differ."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from reference_trainer.evaluation.results import machine, write_json
from reference_trainer.files import write_text
from reference_trainer.json_files import read_json
from reference_trainer.runs.folder import CHECKPOINT
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.studies.ranking_report import correlations, ranking_figure, ranking_report
from reference_trainer.studies.ranking_scores import VARIANTS, Ranking, RunScores, score_run
from reference_trainer.training.config import TrainConfig

__all__ = ["rank_runs", "study_ranking"]

Say = Callable[[str], None]


def rank_runs(
    runs: Sequence[Path],
    out: Path,
    *,
    split: str = "test",
    views: int | None = None,
    device: str = "cpu",
    say: Say = print,
) -> Ranking:
    """Measure all variants on every run; what was measured before, on the same checkpoint, is not measured again.

    Args:
        runs: folders of runs.
        out: folder of the study; each finished run leaves a file in ``measured/``, the one in progress its views.
        split: ``"train"`` or ``"test"``: which views to measure.
        views: measure only the first so many; None for all.
        device: where to render.
        say: receives a line for every run and every view.

    Returns:
        The measurements, sorted by scene and by the exact score.

    Raises:
        ValueError: if there is no run, no such split, or no view to measure.
        FileNotFoundError: if a folder holds no run.
    """
    folders = list(dict.fromkeys(run.resolve() for run in runs))
    if not folders:
        raise ValueError("expected at least 1 run, got none: give the --out folders of ca-reg train.")
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', got {split!r}.")
    if views is not None and views < 1:
        raise ValueError(f"views must be at least 1, or None for all, got {views}.")
    found = []
    for number, folder in enumerate(folders, start=1):
        file = out / "measured" / _file_name(folder, split, views)
        if not file.exists():
            say(f"[{number}/{len(folders)}] {folder}")
            keep = file.with_suffix(".partial.json")
            scores = score_run(folder, split=split, views=views, device=device, keep=keep, say=say)
            write_json(file, dataclasses.asdict(scores))
            keep.unlink(missing_ok=True)
        found.append(_read(file))
    # nan compares with nothing: without a score, last
    found.sort(key=lambda run: (run.scene, not math.isfinite(run.mean("exact")), run.mean("exact")))
    return Ranking(split, tuple(found))


def study_ranking(
    runs: Sequence[Path],
    out: Path,
    *,
    split: str = "test",
    views: int | None = None,
    device: str = "cpu",
    say: Say = print,
) -> Ranking:
    """Measure all runs and write ``ranking.json``, ``ranking.md`` and ``ranking.png``.

    Args:
        runs: folders of runs.
        out: folder of the study; an interrupted study continues.
        split: ``"train"`` or ``"test"``: which views to measure.
        views: measure only the first so many; None for all.
        device: where to render.
        say: receives the progress and the tables.

    Returns:
        The measurements.

    Raises:
        ValueError: as for `rank_runs`.
        FileNotFoundError: if a folder holds no run.
    """
    ranking = rank_runs(runs, out, split=split, views=views, device=device, say=say)
    write_json(
        out / "ranking.json",
        {
            **dataclasses.asdict(ranking),
            "correlations": {scene: correlations(members) for scene, members in ranking.scenes().items()},
            "machine": machine(),
        },
    )
    text = ranking_report(ranking)
    write_text(out / "ranking.md", text)
    ranking_figure(ranking, out / "ranking.png")
    say(text)
    say(f"Tables, numbers and figure are in {out}")
    return ranking


def _file_name(folder: Path, split: str, views: int | None) -> str:
    """Name the file of a measurement after all that decides it, the time of the checkpoint included."""
    if not (folder / CHECKPOINT).exists():
        raise FileNotFoundError(f"{folder} holds no run (no {CHECKPOINT}): give the --out folder of ca-reg train.")
    # With a new setting former measurements cannot tell which strategy they belong to.
    settings = [field.name for kind in (SceneOptions, TrainConfig) for field in dataclasses.fields(kind)]
    key = [str(folder), (folder / CHECKPOINT).stat().st_mtime_ns, split, views, list(VARIANTS), settings]
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:12]
    return f"{folder.parent.name}_{folder.name}_{digest}.json"


def _read(file: Path) -> RunScores:
    """Read a measurement; what JSON has no word for was nan."""
    data = read_json(file)
    views = [{name: math.nan if x is None else x for name, x in view.items()} for view in data.pop("views")]
    return RunScores(**data, views=views)
