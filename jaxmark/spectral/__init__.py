"""Differentiable spectral filtering of meshes by polynomials and rational functions of the graph Laplacian.

`from_mesh`, `from_edges`, `from_points` and `from_matrices` build the operator of a graph. `bands` has families of band
filters as Chebyshev coefficients. `filter` applies one filter to a signal, and `band_components` a whole family;
`inverse` recovers a signal from its parts. `cheb_conv` is a layer of learned filters. `eigenpairs` is the exact
reference.
"""

from jaxmark.spectral import bands as bands
from jaxmark.spectral.bands import fit as fit
from jaxmark.spectral.chebyshev import band_components as band_components
from jaxmark.spectral.chebyshev import cross_moments as cross_moments
from jaxmark.spectral.chebyshev import filter as filter
from jaxmark.spectral.chebyshev import gram as gram
from jaxmark.spectral.chebyshev import heat as heat
from jaxmark.spectral.chebyshev import moments as moments
from jaxmark.spectral.chebyshev import synthesise as synthesise
from jaxmark.spectral.chebyshev import transpose as transpose
from jaxmark.spectral.frames import frame_bounds as frame_bounds
from jaxmark.spectral.frames import inverse as inverse
from jaxmark.spectral.frames import tight as tight
from jaxmark.spectral.frozen import FrozenLaplacian as FrozenLaplacian
from jaxmark.spectral.frozen import freeze as freeze
from jaxmark.spectral.graphs import from_edges as from_edges
from jaxmark.spectral.graphs import from_matrices as from_matrices
from jaxmark.spectral.graphs import from_mesh as from_mesh
from jaxmark.spectral.graphs import from_points as from_points
from jaxmark.spectral.laplacian import Laplacian as Laplacian
from jaxmark.spectral.laplacian import Operator as Operator
from jaxmark.spectral.laplacian import centre as centre
from jaxmark.spectral.laplacian import sparse_matrices as sparse_matrices
from jaxmark.spectral.learned import cheb_conv as cheb_conv
from jaxmark.spectral.learned import init_cheb_conv as init_cheb_conv
from jaxmark.spectral.padding import stack as stack
from jaxmark.spectral.product import Factors as Factors
from jaxmark.spectral.product import filter_by_factors as filter_by_factors
from jaxmark.spectral.product import lagrange_factors as lagrange_factors
from jaxmark.spectral.rational import butterworth as butterworth
from jaxmark.spectral.rational import filter_rational as filter_rational
from jaxmark.spectral.sharding import ShardedLaplacian as ShardedLaplacian
from jaxmark.spectral.sharding import filter_sharded as filter_sharded
from jaxmark.spectral.sharding import shard as shard
from jaxmark.spectral.spectrum import Eigenpairs as Eigenpairs
from jaxmark.spectral.spectrum import Quadrature as Quadrature
from jaxmark.spectral.spectrum import eigenpairs as eigenpairs
from jaxmark.spectral.spectrum import quadrature as quadrature
from jaxmark.spectral.spectrum import white_probes as white_probes
from jaxmark.spectral.subspaces import LowestPairs as LowestPairs
from jaxmark.spectral.subspaces import lowest_eigenpairs as lowest_eigenpairs
from jaxmark.spectral.subspaces import quadratic_form as quadratic_form
from jaxmark.spectral.subspaces import trace as trace
from jaxmark.spectral.weights import cotangent_weights as cotangent_weights
from jaxmark.spectral.weights import inverse_length_weights as inverse_length_weights
from jaxmark.spectral.weights import vertex_areas as vertex_areas
