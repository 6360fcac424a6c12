"""Drawing with OpenGL through moderngl and EGL, without a window (extra ``gl``).

Every sample of a pixel has a tile of its own in one large image, drawn with the camera moved by the sample's offset: the
samples are those of the rasteriser. A second pass gathers the tiles into pixels. OpenGL has the centre of pixel ``i`` at
``i + 0.5``, this project has it at ``i``; rows run downwards in memory here, so nothing is flipped.
"""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchtrack.errors import MissingExtraError
from torchtrack.sim.drawing import Light, Picture, Region, sample_offsets
from torchtrack.sim.surface import Scene

_VERTEX = """
#version 330
uniform mat3 rotation; uniform vec3 translation;
uniform vec4 intrinsics;   // fx, fy, and the principal point from the tile's corner
uniform vec2 size; uniform float near;
in vec3 position; in vec3 normal; in vec3 face_normal; in vec2 uv; in float albedo; in float gloss;
out vec3 at; out vec3 towards; out vec2 texel; out float reflectance; flat out float shine; flat out float back;
void main() {
    at = rotation * position + translation;
    vec3 facing = rotation * face_normal;
    back = dot(facing, at) > 0.0 ? 1.0 : 0.0;
    towards = (rotation * normal) * (1.0 - 2.0 * back);
    texel = uv; reflectance = albedo; shine = gloss;
    vec2 pixel = intrinsics.xy * at.xy + intrinsics.zw * at.z;
    gl_Position = vec4(2.0 * pixel / size - at.z, 2.0 * near - at.z, at.z);
}
"""
_FRAGMENT = """
#version 330
uniform sampler2D print; uniform vec3 light; uniform float ambient; uniform float diffuse; uniform float number; uniform float closed;
in vec3 at; in vec3 towards; in vec2 texel; in float reflectance; flat in float shine; flat in float back;
out vec4 result;
void main() {
    // The back of a closed surface is never seen.
    if (closed * back > 0.5) discard;
    vec3 n = normalize(towards);
    float highlight = pow(max(dot(n, normalize(normalize(-at) + light)), 0.0), 32.0);
    float lit = ambient + diffuse * max(dot(n, light), 0.0);
    result = vec4(reflectance * texture(print, texel).r * lit + shine * highlight, 1.0 / at.z, number, 1.0);
}
"""
_WHOLE = """
#version 330
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }
"""
_GATHER = """
#version 330
uniform sampler2D tiles; uniform ivec2 size; uniform int n;
out vec4 result;
void main() {
    vec4 samples[64];
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float light = 0.0, covered = 0.0;
    for (int s = 0; s < n * n; ++s) {
        samples[s] = texelFetch(tiles, pixel + ivec2(s % n, s / n) * size, 0);
        light += samples[s].a * samples[s].r; covered += samples[s].a;
    }
    // The pixel goes to whoever holds most of its samples.
    float best = -1.0, most = float(n * n) - covered, inverse = 1.0;
    for (int s = 0; s < n * n; ++s) {
        float count = 0.0, total = 0.0;
        for (int q = 0; q < n * n; ++q)
            if (samples[q].a > 0.0 && samples[q].b == samples[s].b) { count += 1.0; total += samples[q].g; }
        if (samples[s].a > 0.0 && count > most) { best = samples[s].b; most = count; inverse = total / count; }
    }
    result = vec4(light / float(n * n), 1.0 - covered / float(n * n), best, 1.0 / inverse);
}
"""


class OpenGLDrawer:
    """OpenGL 3.3 on whatever EGL offers: a GPU, or Mesa's software.

    Args:
        scene: what to draw.
        intrinsics: ``fx, fy, cx, cy``.
        near_m: surfaces nearer than this are not drawn.
        supersampling: samples per pixel along each axis.

    Raises:
        MissingExtraError: if EGL offers no OpenGL here.
    """

    def __init__(self, scene: Scene, intrinsics: tuple[float, float, float, float], near_m: float, supersampling: int) -> None:
        self._gl = open_context()
        self._scene, self._intrinsics, self._near, self._n = scene, intrinsics, near_m, supersampling
        self._offsets = sample_offsets(supersampling)
        self._points = [np.unique(scene.corners[faces].reshape(-1, 3), axis=0) for faces in scene.object_faces]
        self._program = self._gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._gather = self._gl.program(vertex_shader=_WHOLE, fragment_shader=_GATHER)
        corners = self._gl.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32).tobytes())
        self._whole = self._gl.vertex_array(self._gather, [(corners, "2f", "corner")])
        self._parts = [[(self._upload(faces), self._texture(faces.start)) for faces in of_object] for of_object in scene.part_faces]
        self._targets: tuple[tuple[int, int], moderngl.Framebuffer, moderngl.Texture, moderngl.Framebuffer] | None = None

    def _upload(self, faces: slice) -> moderngl.VertexArray:
        """The triangles of one part."""
        scene, look = self._scene, self._scene.look
        corners = scene.corners[faces]
        face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-30)
        columns = [
            corners,
            scene.normals[faces],
            np.repeat(face_normals[:, None], 3, axis=1),
            look["uv"][faces],
            look["albedo"][faces][..., None],
            np.repeat(look["gloss"][faces][:, None, None], 3, axis=1),
        ]
        data = np.concatenate([column.reshape(-1, column.shape[-1]) for column in columns], 1).astype(np.float32)
        names = ("position", "normal", "face_normal", "uv", "albedo", "gloss")
        return self._gl.vertex_array(self._program, [(self._gl.buffer(data.tobytes()), "3f 3f 3f 2f 1f 1f", *names)])

    def _texture(self, face: int) -> moderngl.Texture:
        """The print of the part that a face belongs to."""
        start, width, height = self._scene.look["texture"][face].tolist()
        texture = self._gl.texture((width, height), 1, self._scene.look["texels"][start : start + width * height].tobytes(), dtype="f4", alignment=4)
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        return texture

    def place(self, T_cam_obj: Float[ndarray, "o 4 4"], light: Light) -> list[Float[ndarray, "_ 3"]]:
        """Set poses and light for the next image; returns corners of every object in the camera frame."""
        self._T, program = T_cam_obj, self._program
        program["light"], program["ambient"], program["diffuse"] = tuple(light.unit.tolist()), light.ambient, light.diffuse
        return [points @ T[:3, :3].T + T[:3, 3] for points, T in zip(self._points, T_cam_obj, strict=True)]

    def draw(self, region: Region, numbers: Sequence[int], picture: Picture) -> None:
        """Draw some of the objects into one region, over the background that its picture holds."""
        height, width = picture.luminance.shape
        tiles, samples, pixels = self._room((width, height))
        self._draw_tiles(tiles, region, numbers, (width, height))
        pixels.use()
        pixels.viewport = (0, 0, width, height)
        self._gl.disable(moderngl.DEPTH_TEST)
        samples.use(0)
        self._gather["tiles"], self._gather["size"], self._gather["n"] = 0, (width, height), self._n
        self._whole.render()
        result = np.frombuffer(pixels.read((0, 0, width, height), 4, dtype="f4"), dtype=np.float32).reshape(height, width, 4)
        picture.luminance[:] = result[..., 0] + result[..., 1] * picture.luminance
        held = result[..., 2] >= 0
        picture.object_index[held], picture.depth[held] = result[..., 2][held], result[..., 3][held]

    def _draw_tiles(self, tiles: moderngl.Framebuffer, region: Region, numbers: Sequence[int], size: tuple[int, int]) -> None:
        fx, fy, cx, cy = self._intrinsics
        program, (width, height) = self._program, size
        tiles.use()
        tiles.viewport = (0, 0, self._n * width, self._n * height)
        tiles.clear(0.0, 0.0, -1.0, 0.0, depth=0.0)
        self._gl.enable(moderngl.DEPTH_TEST)
        # Nearer is larger: depth is the inverse of z.
        self._gl.depth_func = ">"
        program["size"], program["near"], program["print"] = (width, height), self._near, 0
        for number in numbers:
            T = self._T[number]
            program["rotation"], program["translation"] = tuple(T[:3, :3].T.ravel().tolist()), tuple(T[:3, 3].tolist())
            program["number"], program["closed"] = float(number), float(self._scene.is_closed[number])
            for s, (dx, dy) in enumerate(self._offsets.tolist()):
                tiles.viewport = (s % self._n * width, s // self._n * height, width, height)
                program["intrinsics"] = (fx, fy, cx - region.left - dx + 0.5, cy - region.top - dy + 0.5)
                for triangles, texture in self._parts[number]:
                    texture.use(0)
                    triangles.render()

    def _room(self, size: tuple[int, int]) -> tuple[moderngl.Framebuffer, moderngl.Texture, moderngl.Framebuffer]:
        """Images for the tiles (with what holds their colours) and for the pixels, kept as long as they are large enough."""
        if self._targets is None or self._targets[0][0] < size[0] or self._targets[0][1] < size[1]:
            old = self._targets[0] if self._targets else (0, 0)
            width, height = max(old[0], size[0]), max(old[1], size[1])
            large = (self._n * width, self._n * height)
            samples = self._gl.texture(large, 4, dtype="f4")
            tiles = self._gl.framebuffer([samples], self._gl.depth_texture(large))
            self._targets = (width, height), tiles, samples, self._gl.framebuffer([self._gl.texture((width, height), 4, dtype="f4")])
        return self._targets[1:]


def open_context() -> moderngl.Context:
    """An OpenGL context without a window.

    Raises:
        MissingExtraError: if EGL offers none.
    """
    settings: dict[str, Any] = {"backend": "egl"}
    try:
        return moderngl.create_context(standalone=True, **settings)
    except Exception as error:  # moderngl raises plain Exception
        raise MissingExtraError(
            "libEGL", "gl", f"Rendering simulated scenes with OpenGL found no EGL here ({error}); use render.backend rasterizer, or"
        ) from error
