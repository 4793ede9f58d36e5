"""`python -m kerv_cli` is `kerv`."""

from kerv_cli.app import main

main()
