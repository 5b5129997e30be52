"""The built-in methods, of the literature and of this library; see `jaxmark.bench.method.METHODS`."""
