"""What several programs share; each puts the folder above its own on the path, and so runs wherever it is copied to."""
