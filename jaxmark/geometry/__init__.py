"""Triangle meshes as arrays: validation, welding, edges, areas and normals, poses, closest points, vertex matching.

All of it runs on the host with NumPy; a `Mesh` itself also goes through `jit`, `vmap` and `grad`.
"""

from jaxmark.geometry._asteroid import asteroid as asteroid
from jaxmark.geometry.canonical import geometry_hash as geometry_hash
from jaxmark.geometry.connectivity import matching_vertices as matching_vertices
from jaxmark.geometry.mesh import Mesh as Mesh
from jaxmark.geometry.mesh import Weld as Weld
from jaxmark.geometry.mesh import area as area
from jaxmark.geometry.mesh import components as components
from jaxmark.geometry.mesh import diagonal as diagonal
from jaxmark.geometry.mesh import displacement as displacement
from jaxmark.geometry.mesh import edges as edges
from jaxmark.geometry.mesh import face_normals as face_normals
from jaxmark.geometry.mesh import make_mesh as make_mesh
from jaxmark.geometry.mesh import vertex_normals as vertex_normals
from jaxmark.geometry.mesh import weld as weld
from jaxmark.geometry.mesh import weld_mesh as weld_mesh
from jaxmark.geometry.pose import Pose as Pose
from jaxmark.geometry.skinning import Skinning as Skinning
from jaxmark.geometry.skinning import unpose as unpose
from jaxmark.geometry.surfaces import Surface as Surface
