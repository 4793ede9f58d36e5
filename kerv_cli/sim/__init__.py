"""The world: Meta-World behind a small interface. Importing this package loads neither metaworld nor mujoco."""
