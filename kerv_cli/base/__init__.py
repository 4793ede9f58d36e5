"""What all packages of kerv use: errors, files, limits, spaces, the registry, settings. Only `config.py` uses Hydra."""
