"""The command line: commands that mark and read files and folders, the demo, the dossier, and the catalogue's page."""
