"""`python -m colorphase` of the wheel."""

from pipeline.cli.start import main

main()
