"""The `kerv` command: one file per command. Parse, call one function below, print."""
