"""Interactive viewing of a model in a browser, rendered by this package; ``window.py`` needs viser."""
