"""A self-contained HTML page about runs: figures, pictures, and the models in an interactive 3D view."""
