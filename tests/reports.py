"""What the tests of the page of `ca-reg report` share: the page as a parser reads it, and runs to write one of."""

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import CHROMIUM

from reference_trainer.evaluation.results import write_json
from reference_trainer.runs.folder import CHECKPOINT, CONFIG, run_settings
from reference_trainer.scenes import load_scene
from reference_trainer.scenes.options import SceneOptions
from reference_trainer.scenes.scene import Scene, View
from reference_trainer.training.config import TrainConfig
from reference_trainer.training.trainer import Trainer

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")


class Parsed(HTMLParser):
    """A page: its tags with their attributes, and the texts inside of them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.texts, self._open = dict[str, str](), ""
        self.text = path.read_text("utf-8")
        self.feed(self.text)
        self.data = json.loads(self.texts["data"], parse_constant=pytest.fail)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._open = dict(attributes).get("id", tag)

    def handle_data(self, text):
        self.texts[self._open] = self.texts.get(self._open, "") + text


def two_of_each(scene: Scene) -> list[View]:
    """The views of a page that shows two of each split."""
    return [scene.test[0], scene.test[-1], scene.train[0], scene.train[-1]]


def unfinished(folder: Path, options: SceneOptions, config: TrainConfig) -> Trainer:
    """Train a run for some steps and leave it."""
    trainer = Trainer(load_scene(options), config)
    trainer.train(until=4)
    trainer.save(folder / CHECKPOINT)
    write_json(folder / CONFIG, run_settings(options, config))
    return trainer
