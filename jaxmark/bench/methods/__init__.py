"""Methods of the literature and of this library, one publication a module; `jaxmark.bench.METHODS` names them."""
