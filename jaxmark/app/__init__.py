"""Whole jobs on files: the command line, folders of files, the demo."""
