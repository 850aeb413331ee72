"""Interactive viewing of a model in a browser, drawn by this package's renderer; ``window.py`` needs viser."""
