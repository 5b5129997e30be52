"""glTF 2.0 in both of its forms, GLB and JSON."""
