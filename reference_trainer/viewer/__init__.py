"""A model to turn in a browser, drawn by the renderer of this package; ``window.py`` needs viser."""
