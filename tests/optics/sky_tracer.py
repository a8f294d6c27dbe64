"""A tracer that shares nothing with the package: one global frame with z to the sky, Newton's method.

Segments move as material bodies. Images are Huygens' sum over the rays' points on the reference sphere.
"""

from dataclasses import dataclass

import numpy as np


def turn(angles):
    """Rx Ry Rz, right handed."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


def no_figure(x, y):
    return np.zeros((3, len(x)))


def bounce(p, d, curvature, conic, figure=no_figure):
    """Path to z = sag + figure in the surface's frame, and the new direction."""
    path = -p[:, 2] / d[:, 2]
    for _ in range(20):
        x, y, z = (p + path[:, None] * d).T
        root = np.sqrt(1 - (1 + conic) * curvature**2 * (x**2 + y**2))
        height, slope_x, slope_y = figure(x, y)
        normal = np.stack(
            [-curvature * x / root - slope_x, -curvature * y / root - slope_y, np.ones_like(x)], 1
        )
        over = z - curvature * (x**2 + y**2) / (1 + root) - height
        path -= over / np.sum(normal * d, axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return path, d - 2 * np.sum(d * normal, axis=1)[:, None] * normal


@dataclass(frozen=True)
class Tracer:
    """M1 (curvature, conic), mirrors (vertex, axes, curvature, conic), image (origin, axes), sphere; mm."""

    primary: tuple
    mirrors: tuple
    origin: np.ndarray
    axes: np.ndarray
    sphere: float
    start: float = 3000.0

    def rays(self, x, y, on_sky=(0, 0), body=None, figure=no_figure, m2=(0, 0)):
        """Points on the image plane, directions and path lengths; `body` is (center, axes, six motions)."""
        d = np.array([*np.tan(on_sky), -1.0])
        d = np.broadcast_to(d / np.linalg.norm(d), (len(x), 3))
        p = np.stack([x, y, np.full(len(x), self.start)], axis=1)
        length = p @ d[0]
        center, axes, motion = body or (np.zeros(3), np.eye(3), np.zeros(6))
        rotation = axes @ turn(motion[3:]) @ axes.T
        back = (p - center - axes @ motion[:3]) @ rotation + center
        path, local = bounce(back, d @ rotation, *self.primary, figure)
        p, d, length = p + path[:, None] * d, local @ rotation.T, length + path
        for index, (vertex, frame, curvature, conic) in enumerate(self.mirrors):
            frame = turn([*m2, 0]) @ frame if index == 0 else frame
            path, local = bounce((p - vertex) @ frame, d @ frame, curvature, conic)
            p, d, length = p + path[:, None] * d, local @ frame.T, length + path
        path = (self.origin - p) @ self.axes[:, 2] / (d @ self.axes[:, 2])
        return p + path[:, None] * d, d, length + path

    def in_image(self, p):
        return (p - self.origin) @ self.axes[:, :2]

    def chief(self, stop_z, on_sky=(0, 0), m2=(0, 0)):
        """The ray through the middle of the stop, which lies `stop_z` above M1's vertex."""
        x, y = np.tan(on_sky) * (self.start - stop_z) * -1
        return self.rays(np.array([x]), np.array([y]), on_sky, m2=m2)

    def on_sphere(self, rays, chief):
        """OPD, and points and lengths where the rays meet the reference sphere."""
        p, d, length = rays
        offset = p - chief[0][0]
        along = np.sum(offset * d, axis=1)
        back = along + np.sqrt(along**2 - np.sum(offset**2, axis=1) + self.sphere**2)
        return chief[2][0] - self.sphere - (length - back), p - back[:, None] * d, length - back


def tmt(primary, m2_radius, sphere):
    """M2 above M1, a fold mirror 3.5 m above M1's vertex that sends the light to -x, 20 m to the image."""
    half = np.sqrt(0.5)
    fold = np.array([[half, 0, -half], [0, 1, 0], [half, 0, half]])
    mirrors = (
        (np.array([0, 0, 27093.75]), np.eye(3), 1 / m2_radius, -1.31822813),
        (np.array([0, 0, 3500.0]), fold, 0.0, 0.0),
    )
    # The mirrored x axis of the pupil points up there, y stays y.
    axes = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    return Tracer(primary, mirrors, np.array([-np.sqrt(2) * 14142.136, 0, 3500]), axes, sphere)


def jwst(sphere):
    """Cassegrain of the published radii and focal length; the focus lies `magnified` below M2."""
    f1, f2, focal = 15879.7 / 2, 1778.913 / 2, 131400.0
    m = focal / f1
    before_focus = f2 * (1 - 1 / m)
    m2 = (np.array([0, 0, f1 - before_focus]), np.eye(3), 0.5 / f2, -(((m + 1) / (m - 1)) ** 2))
    origin = np.array([0, 0, f1 - before_focus - m * before_focus])
    return Tracer((0.5 / f1, -1.0), (m2,), origin, np.diag([1.0, 1, -1]), sphere)


def frame_on(primary, x, y):
    """Center and axes of a segment: normal to the sky, x axis above the global one."""
    curvature, conic = primary
    root = np.sqrt(1 - (1 + conic) * curvature**2 * (x**2 + y**2))
    normal = np.array([-curvature * x / root, -curvature * y / root, 1.0])
    normal /= np.linalg.norm(normal)
    along = np.array([1.0, 0, 0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    center = np.array([x, y, curvature * (x**2 + y**2) / (1 + root)])
    return center, np.stack([along, np.cross(normal, along), normal], axis=1)


def glass(corners, count):
    """A grid over each polygon: points, segments and weights that sum to 1."""
    points, segments, weights = [], [], []
    for index, polygon in enumerate(corners):
        low, step = polygon.min(axis=0), np.ptp(polygon, axis=0) / count
        grid = low + step * (
            np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2) + 0.5
        )
        edge = np.roll(polygon, -1, axis=0) - polygon
        away = grid[:, None] - polygon
        grid = grid[(edge[:, 0] * away[..., 1] - edge[:, 1] * away[..., 0] >= 0).all(axis=1)]
        area = 0.5 * np.sum(
            polygon[:, 0] * np.roll(polygon[:, 1], -1) - polygon[:, 1] * np.roll(polygon[:, 0], -1)
        )
        points.append(grid)
        segments.append(np.full(len(grid), index))
        weights.append(np.full(len(grid), area / len(grid)))
    weight = np.concatenate(weights)
    return np.concatenate(points), np.concatenate(segments), weight / weight.sum()


@dataclass(frozen=True)
class Whole:
    opd: np.ndarray
    points: np.ndarray
    lengths: np.ndarray
    spots: np.ndarray
    chief: np.ndarray


def whole(tracer, bench, pupil, segment_motion, on_sky=(0, 0), m2=(0, 0)):
    points, segments, _ = pupil
    stop_z = -bench.system.stop_z
    chief = tracer.chief(stop_z, on_sky, m2)
    parts = []
    for index, motion in enumerate(segment_motion):
        # Rays start in the stop plane.
        x, y = points[segments == index].T
        rise = tracer.start - stop_z
        shift = -np.tan(on_sky) * rise
        body = (
            *frame_on(tracer.primary, *bench.layout.centers_m[index, :2] * 1e3),
            motion * ([1e3] * 3 + [1] * 3),
        )
        rays = tracer.rays(x + shift[0], y + shift[1], on_sky, body, m2=m2)
        parts.append((*tracer.on_sphere(rays, chief), tracer.in_image(rays[0])))
    opd, on_sphere, lengths, spots = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Whole(opd, on_sphere, lengths, spots, tracer.in_image(chief[0])[0])


def huygens(tracer, state, weight, x, y, wavelength):
    """Irradiance at places in the image plane, by the distance from every point of the reference sphere."""
    places = tracer.origin + np.stack([x.ravel(), y.ravel()], axis=1) @ tracer.axes[:, :2].T
    lengths = state.lengths - state.lengths.mean()
    field = [
        weight
        @ np.exp(
            2j * np.pi / wavelength * (lengths + np.linalg.norm(place - state.points, axis=1) - tracer.sphere)
        )
        for place in places
    ]
    return np.abs(field).reshape(x.shape) ** 2
