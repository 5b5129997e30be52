"""Modules that several programs share. Each program adds the folder above its own to the path, so it runs anywhere."""
