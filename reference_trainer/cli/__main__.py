"""``python -m reference_trainer.cli`` is ``ca-reg``."""

from reference_trainer.cli import main

main()
