"""Methods of the literature and of this library, one publication a module; see `jaxmark.bench.method.METHODS`."""
