"""`python -m kerv_cli` is `kerv`."""

from kerv_cli.cli.app import main

main()
