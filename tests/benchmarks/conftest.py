"""Tiny scenes and schedules, as for the tests of the trainer."""

from tiny import busy as busy
from tiny import options as options
from tiny import short as short
from tiny import tiny_scene as tiny_scene
