"""One HTML page about runs, which needs nothing but a browser: figures, pictures, and the models to turn around."""
