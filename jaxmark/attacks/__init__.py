"""Attacks: changes of a marked mesh that happen by accident, or that common tools make.

`jaxmark.adversaries.by_name.ATTACKS` lists them by their names, with those of keyless attackers. An attack is a
function `(mesh, strength, seed)` that returns the attacked mesh; `mark_noise` alone takes the original, too. Its
docstring defines the strength. The seed is a whole number or a JAX random key, on the host also a NumPy generator;
attacks that make no random choice ignore it. Vertices that no face uses are not part of the surface: they neither move
nor count.

Attacks are traced functions, unless their docstring or that of their module says that they run on the host. Under
`jit`, `vmap` and `grad`, close over the faces, because graphs are prepared on the host. Attacks on the host take any
concrete mesh.

All raise `JaxmarkError` if the strength is outside of the stated range, or if a program that they need is missing.
"""

from jaxmark.attacks.attack import Attack as Attack
from jaxmark.attacks.attack import Kind as Kind
from jaxmark.attacks.attack import Step as Step
from jaxmark.attacks.deformation import as_rigid_as_possible as as_rigid_as_possible
from jaxmark.attacks.denoising import nonlocal_means as nonlocal_means
from jaxmark.attacks.denoising import shrinkage as shrinkage
from jaxmark.attacks.flips import edge_flips as edge_flips
from jaxmark.attacks.flips import reordering as reordering
from jaxmark.attacks.noise import diagonal_noise as diagonal_noise
from jaxmark.attacks.noise import gaussian_noise as gaussian_noise
from jaxmark.attacks.noise import mark_noise as mark_noise
from jaxmark.attacks.noise import uniform_noise as uniform_noise
from jaxmark.attacks.parts import adding_geometry as adding_geometry
from jaxmark.attacks.parts import cropping as cropping
from jaxmark.attacks.parts import holes as holes
from jaxmark.attacks.parts import missing_pieces as missing_pieces
from jaxmark.attacks.parts import mosaic as mosaic
from jaxmark.attacks.parts import region_cropping as region_cropping
from jaxmark.attacks.refitting import plane_fitting as plane_fitting
from jaxmark.attacks.refitting import primitive_fitting as primitive_fitting
from jaxmark.attacks.remeshing import iso_surface as iso_surface
from jaxmark.attacks.remeshing import isotropic as isotropic
from jaxmark.attacks.remeshing import poisson as poisson
from jaxmark.attacks.remeshing import simplification as simplification
from jaxmark.attacks.smoothing import bilateral_smoothing as bilateral_smoothing
from jaxmark.attacks.smoothing import cotangent_smoothing as cotangent_smoothing
from jaxmark.attacks.smoothing import laplacian_smoothing as laplacian_smoothing
from jaxmark.attacks.smoothing import taubin_smoothing as taubin_smoothing
from jaxmark.attacks.storage import digits as digits
from jaxmark.attacks.storage import float_bits as float_bits
from jaxmark.attacks.storage import quantisation as quantisation
from jaxmark.attacks.storage import soup as soup
from jaxmark.attacks.subdivision import loop as loop
from jaxmark.attacks.subdivision import midpoint as midpoint
from jaxmark.attacks.subdivision import sqrt3 as sqrt3
from jaxmark.attacks.symmetry import instance_averaging as instance_averaging
from jaxmark.attacks.symmetry import mirror_averaging as mirror_averaging
from jaxmark.attacks.transformations import affine as affine
from jaxmark.attacks.transformations import bending as bending
from jaxmark.attacks.transformations import similarity as similarity
from jaxmark.attacks.transformations import twisting as twisting
from jaxmark.attacks.transformations import warp as warp
