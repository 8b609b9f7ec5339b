"""Meshes to OBJ with their texture as a PNG, to binary STL, and to glTF 2.0 with their texture inside; and back.

They are read by trimesh. Only files next to the mesh are opened, by their plain names: nothing is fetched, and no path
leads elsewhere.

References
----------
Wavefront Technologies, Advanced Visualizer manual, appendix B1: Object files; MTL material format.
Khronos Group, glTF 2.0 specification, 2021 (ISO/IEC 12113:2022).
"""

import io
import json
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError
from pipeline.limits import check_mesh_size, read_plain
from pipeline.output.formats import Content, Heading, remarks_in, text_rows
from pipeline.output.mesh import Mesh, face_normals, vertex_normals
from pipeline.output.range_image import encode_png
from tikernels.raw.linearization import linear_values, srgb_values

_SRGB_TO_LINEAR = linear_values(np.arange(256) / 255, "srgb")
#: What this reads.
READ_SUFFIXES = (".obj", ".stl", ".glb", ".gltf")
# Bytes of an OBJ file in which its remarks are.
_HEAD = 2**16
# A corner that is counted from the last vertex.
_FROM_LAST = re.compile(rb"^\s*f[^\n]*[ /]-", re.MULTILINE)
# A vertex with a colour; and a material, next to which the reader loses such colours.
_COLORED = re.compile(rb"^\s*v(?:[ \t]+\S+){6}", re.MULTILINE)
_MATERIAL = re.compile(rb"^\s*usemtl[^\n]*", re.MULTILINE)


def encode_obj(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as an OBJ file; with a texture also as the material and the picture that it names.

    Without a texture colours follow each place, as MeshLab and others read them.
    """
    comments = heading.comments("#")
    vertices = text_rows("v %.7g %.7g %.7g\n", mesh.vertices)
    if mesh.colors is not None and mesh.texture is None:
        table = np.hstack([mesh.vertices, mesh.colors / np.float32(255)])
        vertices = text_rows("v %.7g %.7g %.7g %.4f %.4f %.4f\n", table)
    # A corner names its vertex, its place in the texture and its normal, which all have the same number here.
    textured, bent = mesh.texture is not None, mesh.normals is not None
    corner = "%d" + ("/%d" if textured else "/" if bent else "") + ("/%d" if bent else "")
    repeated = np.repeat(mesh.faces + 1, 1 + textured + bent, axis=1)
    faces = text_rows(f"f {corner} {corner} {corner}\n", repeated)
    normals = "" if mesh.normals is None else text_rows("vn %.4f %.4f %.4f\n", mesh.normals)
    if mesh.texture is None:
        return {".obj": f"{comments}{vertices}{normals}{faces}".encode()}
    # In an OBJ file a texture's v goes up from the bottom of the picture.
    places = text_rows("vt %.6f %.6f\n", mesh.texture_places() * (1, -1) + (0, 1))
    head = f"{comments}mtllib {heading.stem}.mtl\nusemtl surface\n"
    material = f"{comments}newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {heading.stem}.png\n"
    return {
        # A file's name may have bytes that are not UTF-8.
        ".obj": f"{head}{vertices}{places}{normals}{faces}".encode(errors="surrogateescape"),
        ".mtl": material.encode(errors="surrogateescape"),
        ".png": encode_png(mesh.texture),
    }


def encode_stl(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a binary STL file; of the remarks its head holds what 80 bytes do."""
    normals = face_normals(mesh)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["normal"] = normals / np.where(lengths > 0, lengths, 1)
    triangles["corners"] = mesh.vertices[mesh.faces]
    # A head that begins with "solid" is mistaken for text.
    head = "; ".join(["binary STL", *(f"{name} {value}" for name, value in heading.remarks.items())])
    return {".stl": struct.pack("<80sI", head.encode()[:80], len(triangles)) + triangles.tobytes()}


def _scene_and_buffer(mesh: Mesh, heading: Heading) -> tuple[dict[str, Any], bytes]:
    """Return the description of a glTF scene and its one buffer."""
    if len(mesh.faces) == 0:
        raise OutputError("glTF cannot hold an empty mesh: write a .ply file instead")
    columns: dict[str, npt.NDArray[Any]] = {"POSITION": mesh.vertices, "NORMAL": vertex_normals(mesh)}
    if mesh.texture is not None:
        columns["TEXCOORD_0"] = mesh.texture_places().astype(np.float32)
    elif mesh.colors is not None:
        # glTF's vertex colours are linear light; a fourth channel keeps each on a multiple of four bytes.
        linear = (65535 * _SRGB_TO_LINEAR).round().astype(np.uint16)
        columns["COLOR_0"] = np.pad(linear[mesh.colors], ((0, 0), (0, 1)), constant_values=65535)
    if mesh.flags is not None:
        # What glTF does not know begins with a line; as floats each keeps to a multiple of four bytes.
        columns["_FLAGS"] = mesh.flags[:, None].astype(np.float32)
    blocks = [*columns.values(), mesh.faces.reshape(-1, 1).astype(np.uint32)]
    contents = [block.tobytes() for block in blocks]
    if mesh.texture is not None:
        contents.append(encode_png(mesh.texture))
        contents[-1] += b"\0" * (-len(contents[-1]) % 4)
    offsets = np.cumsum([0, *map(len, contents)]).tolist()
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": index,
            "componentType": {"f4": 5126, "u2": 5123, "u4": 5125}[block.dtype.str[1:]],
            "normalized": block.dtype == np.uint16,
            "count": len(block),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[block.shape[1]],
        }
        for index, block in enumerate(blocks)
    ]
    accessors[0] |= {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    attributes = {name: index for index, name in enumerate(columns)}
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.8}
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": offset, "byteLength": len(content)}
        for offset, content in zip(offsets, contents, strict=False)
    ]
    for index in range(len(blocks)):
        views[index]["target"] = 34963 if index == len(columns) else 34962
    pictures: dict[str, Any] = {}
    if mesh.texture is not None:
        surface["baseColorTexture"] = {"index": 0}
        pictures = {
            "images": [{"bufferView": len(blocks), "mimeType": "image/png"}],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            "textures": [{"source": 0, "sampler": 0}],
        }
    return {
        "asset": {"version": "2.0", "generator": "colorphase", "extras": heading.remarks},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(columns), "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": surface}],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": views,
        "accessors": accessors,
        **pictures,
    }, b"".join(contents)


def encode_glb(mesh: Mesh, heading: Heading) -> dict[str, Content]:
    """Return a mesh as a binary glTF file.

    Raises
    ------
    OutputError
        It has no faces.
    """
    scene, buffer = _scene_and_buffer(mesh, heading)
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    parts = [
        struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer)),
        struct.pack("<I4s", len(text), b"JSON") + text,
        struct.pack("<I4s", len(buffer), b"BIN\0") + buffer,
    ]
    return {".glb": b"".join(parts)}


def read_foreign(path: Path, most_bytes: int) -> tuple[Mesh, dict[str, str]]:
    """Return the mesh of a file of so many bytes at most, in its own coordinates, with colours by vertex; its remarks.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It holds no triangles, more than `max_pixels` allows, or is damaged.
    """
    import trimesh  # slow to import, and seldom needed

    data = read_plain(path, most_bytes)
    beside = _Beside(path.parent, most_bytes)
    try:
        kind = path.suffix[1:].lower()
        remarks = _remarks(data, kind)
        if kind == "obj":
            data = _numbered_from_first(_MATERIAL.sub(b"", data) if _COLORED.search(data) else data)
        elif kind != "stl":
            data = _with_materials(data)
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=beside, process=False)
        # Joined by the reader they would lose colours next to a material.
        solids = [
            (scene.geometry[name], transform) for transform, name in map(scene.graph.get, scene.graph.nodes_geometry)
        ]
        solids = [(solid, transform) for solid, transform in solids if len(getattr(solid, "faces", ()))]
        vertices = [trimesh.transform_points(solid.vertices, transform) for solid, transform in solids]
        starts = np.cumsum([0, *map(len, vertices)])
        faces = [
            start + (solid.faces if np.linalg.det(transform) > 0 else solid.faces[:, ::-1])  # else it is mirrored
            for (solid, transform), start in zip(solids, starts, strict=False)
        ]
        colors = [_colors(solid) for solid, _ in solids]
    except (OSError, MemoryError):
        raise
    except Exception as error:  # its readers raise whatever damaged bytes lead to
        raise ValueError(f"it is damaged, or no such file ({type(error).__name__})") from None
    if not solids:
        raise ValueError("it has no triangles")
    check_mesh_size(int(starts[-1]), sum(map(len, faces)), repeated=6)
    known = [each for each in colors if each is not None]
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(known) if len(known) == len(solids) else None,
    ), remarks


def _with_materials(data: bytes) -> bytes:
    """Return a glTF file in which whatever has colours has a material: else the reader takes their last 8 bits.

    Trimesh writes sRGB without a material, which it reads, in place of the standard's linear light.
    """
    binary = data[:4] == b"glTF"
    begin, end = (20, 20 + int.from_bytes(data[12:16], "little")) if binary else (0, len(data))
    scene = json.loads(data[begin:end])
    parts = [part for mesh in scene.get("meshes", []) for part in mesh["primitives"]]
    bare = [part for part in parts if "COLOR_0" in part["attributes"] and "material" not in part]
    if not bare or "trimesh" in scene["asset"].get("generator", ""):
        return data
    scene["materials"] = [*scene.get("materials", []), {}]
    for part in bare:
        part["material"] = len(scene["materials"]) - 1
    text = json.dumps(scene).encode()
    if not binary:
        return text
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, len(text) + 20 + len(data) - end, len(text), b"JSON")
    return head + text + data[end:]


def _numbered_from_first(data: bytes) -> bytes:
    """Return an OBJ file whose corners are counted from the file's first vertex; -1 is the last one before the line.

    The reader mistakes it for the last one of the file.
    """
    if not _FROM_LAST.search(data):
        return data
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    for number, line in enumerate(lines):
        words = line.split()
        if words[:1] == [b"f"]:
            lines[number] = b" ".join([b"f", *(_corner(word, [*seen.values()]) for word in words[1:])])
        elif words and words[0] in seen:
            seen[words[0]] += 1
    return b"\n".join(lines)


def _corner(word: bytes, seen: list[int]) -> bytes:
    """Return a corner's numbers, of vertex, place in the texture and normal, counted from the first."""
    parts = zip(word.split(b"/"), seen, strict=False)
    return b"/".join(b"%d" % (n + 1 + int(part)) if part.startswith(b"-") else part for part, n in parts)


def _remarks(data: bytes, kind: str) -> dict[str, str]:
    """Return the remarks of a file of ours; none of another's."""
    if kind == "obj":
        return remarks_in(line[1:] for line in data[:_HEAD].decode("utf-8", "replace").splitlines() if line[:1] == "#")
    if kind == "stl":
        return remarks_in(data[:80].decode("utf-8", "replace").rstrip("\0").split(";"))
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data[:4] == b"glTF" else data
    said = json.loads(text)["asset"].get("extras")
    return {str(name): str(value) for name, value in said.items()} if isinstance(said, dict) else {}


def _colors(solid: Any) -> npt.NDArray[np.uint8] | None:
    """Return the sRGB colours of a mesh at its vertices, where it has some, from its texture if need be."""
    visual = solid.visual
    if visual.kind == "texture" and visual.uv is None:
        # Next to a glTF material without a picture; the format's colours are linear light.
        linear = visual.vertex_attributes.get("color")
        if linear is None or len(linear) != len(solid.vertices):
            return None
        full = np.iinfo(linear.dtype).max if linear.dtype.kind == "u" else 1.0
        light = np.clip(linear[:, :3].astype(np.float64) / full, 0, 1)
        return np.asarray(np.rint(255 * srgb_values(light)), np.uint8)
    if not visual.defined:
        return None
    found = np.asarray((visual.to_color() if visual.kind == "texture" else visual).vertex_colors, np.uint8)
    return found[:, :3].copy() if found.shape == (len(solid.vertices), 4) else None


class _Beside(Mapping[str, bytes]):
    """The files next to a mesh, by their plain names, which a mesh may name."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder, self._most_bytes = folder, most_bytes

    def __getitem__(self, name: str) -> bytes:
        if Path(name).name != name:
            raise KeyError(name)
        try:
            return read_plain(self._folder / name, self._most_bytes)
        except (OSError, ValueError):
            raise KeyError(name) from None

    def __iter__(self) -> Iterator[str]:
        return (entry.name for entry in self._folder.iterdir())

    def __len__(self) -> int:
        return sum(1 for _ in self)
