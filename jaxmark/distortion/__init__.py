"""Metrics of distortion: how far vertices were displaced, and how visible the change is.

`compare` computes all of them for two meshes on the host; most are also shown as functions of positions that JAX can
differentiate.
"""

from jaxmark.distortion._compare import LOCAL as LOCAL
from jaxmark.distortion._compare import METRICS as METRICS
from jaxmark.distortion._compare import OF_POINTS as OF_POINTS
from jaxmark.distortion._compare import RENDERED as RENDERED
from jaxmark.distortion._compare import Comparison as Comparison
from jaxmark.distortion._compare import DisplacementSize as DisplacementSize
from jaxmark.distortion._compare import Metric as Metric
from jaxmark.distortion._compare import Reference as Reference
from jaxmark.distortion._compare import compare as compare
from jaxmark.distortion._compare import displacement_size as displacement_size
from jaxmark.distortion._compare import measure as measure
from jaxmark.distortion._compare import metrics_of as metrics_of
from jaxmark.distortion._compare import name_of as name_of
from jaxmark.distortion._compare import shading_at_vertices as shading_at_vertices
from jaxmark.distortion._shading import Masking as Masking
from jaxmark.distortion._shading import Relief as Relief
from jaxmark.distortion._shading import make_masking as make_masking
from jaxmark.distortion._shading import make_relief as make_relief
from jaxmark.distortion._shading import shading as shading
from jaxmark.distortion._shading import vertex_means as vertex_means
from jaxmark.distortion._shading import visible_turn as visible_turn
from jaxmark.distortion.dihedral import dame as dame
from jaxmark.distortion.dihedral import dihedral_angles as dihedral_angles
from jaxmark.distortion.dihedral import make_hinges as make_hinges
from jaxmark.distortion.geometric import geometric_laplacian as geometric_laplacian
from jaxmark.distortion.geometric import gl as gl
from jaxmark.distortion.geometric import stretch as stretch
from jaxmark.distortion.geometric import surface_distance as surface_distance
from jaxmark.distortion.geometric import texture_drift as texture_drift
from jaxmark.distortion.norms import maximum as maximum
from jaxmark.distortion.norms import rms as rms
from jaxmark.distortion.rendered import Difference as Difference
from jaxmark.distortion.rendered import flip as flip
from jaxmark.distortion.rendered import ssim as ssim
from jaxmark.distortion.roughness import fmpd as fmpd
from jaxmark.distortion.roughness import local_roughness as local_roughness
from jaxmark.distortion.structural import curvature as curvature
from jaxmark.distortion.structural import curvature_tensor as curvature_tensor
from jaxmark.distortion.structural import local_msdm2 as local_msdm2
from jaxmark.distortion.structural import msdm as msdm
from jaxmark.distortion.structural import msdm2 as msdm2
from jaxmark.distortion.structural import msdm2_views as msdm2_views
from jaxmark.distortion.structural import msdm_views as msdm_views
from jaxmark.distortion.structural import tensor_distance as tensor_distance
