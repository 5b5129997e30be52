"""Mark the object `model` of scene.blend, save key, original and record, and read the mark from marked.blend."""

from pathlib import Path

import bpy
import numpy as np

import jaxmark as jm


def get_mesh(data: bpy.types.Mesh) -> jm.Mesh:
    """Return a mesh of a scene, with its polygons as the triangles that Blender draws."""
    vertices = np.empty(3 * len(data.vertices), np.float32)
    data.vertices.foreach_get("co", vertices)
    data.calc_loop_triangles()
    faces = np.empty(3 * len(data.loop_triangles), np.int32)
    data.loop_triangles.foreach_get("vertices", faces)
    return jm.make_mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))


def put_back(data: bpy.types.Mesh, mesh: jm.Mesh) -> None:
    """Move the vertices of a mesh in a scene to the positions of a mesh with the same vertices."""
    if data.shape_keys:
        raise SystemExit("This mesh has shape keys; remove or apply them first.")
    data.vertices.foreach_set("co", np.ravel(mesh.vertices).astype(np.float32))
    data.update()


if __name__ == "__main__":
    bpy.ops.wm.open_mainfile(filepath="scene.blend")
    data = bpy.data.objects["model"].data
    original, key = get_mesh(data), jm.new_key()
    marked, info = jm.embed(original, b"jaxmark!", key)
    put_back(data, marked)
    bpy.ops.wm.save_as_mainfile(filepath="marked.blend")
    jm.watermark.save_key(key, "owner.key")
    jm.save_mesh(original, "original.ply")
    Path("record.json").write_text(info.record.to_json())

    # Later: read the mark from a scene.
    bpy.ops.wm.open_mainfile(filepath="marked.blend")
    suspect = get_mesh(bpy.data.objects["model"].data)
    detection = jm.detect(
        suspect,
        original=jm.load_mesh("original.ply"),
        key=jm.watermark.load_key("owner.key"),
        record=jm.Record.load("record.json"),
    )
    print(detection.message, f"log10 p {detection.log10_p:.1f}")
