"""The stacks that every model is set against, one TOML file each, and the directions they are looked at from."""
