"""Write the kernel that traces one shape of a system: the calls of ``kernels/sequential.cl``, one by one."""

from dataclasses import dataclass
from functools import lru_cache

from wavequake.kernels.program import source

OUTPUTS = ("path", "x", "y", "u", "v", "w_sign")

_LEAVES = {
    "path": "STORE(EITHER(lost, (real)NAN, r.path), out_path + out);",
    "x": "STORE(EITHER(lost, (real)NAN, r.position.x), out_x + out);",
    "y": "STORE(EITHER(lost, (real)NAN, r.position.y), out_y + out);",
    "u": "STORE(EITHER(lost, (real)NAN, r.direction.x / r.length), out_u + out);",
    "v": "STORE(EITHER(lost, (real)NAN, r.direction.y / r.length), out_v + out);",
    "w_sign": "STORE_STATUS(EITHER(lost, (mask)0, EITHER(r.direction.z < 0.0, (mask)(-1), (mask)1)), "
    "out_w_sign + out);",
}


@dataclass(frozen=True)
class Part:
    """A polynomial or grid that adds to a surface's height.

    ``call`` is the function of ``sequential.cl`` with its sizes, ``size`` counts the coefficients, ``moves``
    tells whether every instant has its own, and ``place`` is where its fixed numbers start.
    """

    call: str
    size: int
    moves: bool
    place: int


@dataclass(frozen=True)
class Shape:
    """What of an element the kernel's text depends on; ``fixed`` is where its fixed numbers start.

    ``regions`` are (kind, half planes, blocks, where the numbers start); ``even`` is the number of even
    powers and where they start.
    """

    fixed: int
    action: str
    plane: bool
    rotates: bool
    even: tuple[int, int]
    parts: tuple[Part, ...]
    regions: tuple[tuple[str, int, bool, int], ...]

    @property
    def bare(self) -> bool:
        """Whether the surface is nothing but a conic."""
        return not self.even[0] and not self.parts


@lru_cache(maxsize=256)
def kernel_source(
    shapes: tuple[Shape, ...],
    one_direction: bool,
    one_path: bool,
    sphere: bool,
    outputs: tuple[str, ...],
) -> str:
    """Return the OpenCL C of a kernel ``sequential`` for elements of the given shapes.

    Its arguments are: number of rays, fixed numbers, position (3, N), direction (3, N) or (3,), path (N,) or
    (1,), poses, limits, spheres, one array for each part of each element; then `outputs`, status and surface.
    """
    parts = [(i, k, part) for i, shape in enumerate(shapes) for k, part in enumerate(shape.parts)]
    names = [f"part_{i}_{k}" for i, k, _ in parts]
    pointers = [_pointer(name, part) for name, (_, _, part) in zip(names, parts, strict=True)]
    deformed = [i for i, shape in enumerate(shapes) if not shape.bare]
    lines = [source("sequential.cl")]
    lines.append(
        "typedef struct { __global const double *fixed" + "".join(f", *{n}" for n in names) + "; } numbers;"
    )
    meet = source("deformed.cl") if deformed else ""
    for i in deformed:
        lines += [_height(i, shapes[i]), f"#define NUMBER {i}", meet]
    inputs = ["fixed", "position", "direction", "path", "poses", "limits", "spheres", *names]
    arguments = [f"__global const double *{name}" for name in inputs]
    arguments += [f"__global {'char' if name == 'w_sign' else 'double'} *out_{name}" for name in outputs]
    arguments += ["__global char *out_status", "__global char *out_surface"]
    lines += [
        f"__kernel void sequential(const int rays, {', '.join(arguments)})",
        "{",
        "    const size_t instant = get_global_id(2);",
        "    // The last group overlaps the one before it, so that all lanes are rays.",
        "    const size_t group = get_global_id(1) * W;",
        "    if (group >= rays)",
        "        return;",
        "    const size_t n = group + W > rays ? rays - W : group;",
        f"    numbers t = {{{', '.join(['fixed', *pointers])}}};",
        f"    poses += instant * {12 * len(shapes)};",
        f"    limits += instant * {len(deformed)};",
        "    ray r;",
        *(
            f"    r.position.{axis} = LOAD(position + {k} * (size_t)rays + n);"
            for k, axis in enumerate("xyz")
        ),
        *(
            f"    r.direction.{axis} = {_given('direction', k, one_direction)};"
            for k, axis in enumerate("xyz")
        ),
        f"    r.path = {_given('path', 0, one_path)};",
        "    r.length = 1.0;",
        "    mask code = 0, met, missed;",
        "    triple normal;",
    ]
    for i, shape in enumerate(shapes):
        lines += ["    " + line for line in _element(i, shape, deformed)]
    lines += (
        [f"    met = to_sphere(&r, spheres + 4 * instant, fixed[{shapes[-1].fixed + 4}]);"] if sphere else []
    )
    lines += [f"    code = lose(code, NOT(met), MISS, {len(shapes)});"] if sphere else []
    lines += ["    const size_t out = instant * rays + n;", "    const mask lost = code != 0;"]
    lines += ["    " + _LEAVES[name] for name in outputs]
    lines += ["    STORE_STATUS(status_of(code), out_status + out);"]
    lines += ["    STORE_STATUS(surface_of(code), out_surface + out);", "}", ""]
    return "\n".join(lines)


def _pointer(name: str, part: Part) -> str:
    return f"{name} + instant * {part.size}" if part.moves else name


def _given(name: str, row: int, single: bool) -> str:
    return f"{name}[{row}]" if single else f"LOAD({name} + {row} * (size_t)rays + n)"


def _height(i: int, shape: Shape) -> str:
    """Return the function of an element's height over its conic, with slopes."""
    calls = (
        [f"even_powers(t.fixed + {shape.even[1]}, {shape.even[0]}, x, y, sx, sy)"] if shape.even[0] else []
    )
    calls += [
        part.call.format(array=f"t.part_{i}_{k}", place=f"t.fixed + {part.place}")
        for k, part in enumerate(shape.parts)
    ]
    lines = [f"INLINE real height_{i}(numbers t, real x, real y, real *sx, real *sy)", "{"]
    lines += ["    *sx = 0.0;", "    *sy = 0.0;", f"    real height = {calls[0]};"]
    lines += [f"    height += {call};" for call in calls[1:]]
    return "\n".join([*lines, "    return height;", "}"])


def _element(i: int, shape: Shape, deformed: list[int]) -> list[str]:
    """Return the calls for one element; its fixed numbers are c, k1, index before, ratio, index, reach."""
    c, k1, index, ratio, _, reach = (f"fixed[{shape.fixed + k}]" for k in range(6))
    lines = [f"{'rotate_and_shift' if shape.rotates else 'shift'}(&r, poses + {12 * i});"]
    if shape.bare:
        call = f"meet_plane(&r, {index}" if shape.plane else f"meet_conic(&r, {c}, {k1}, {index}"
        lines += [f"met = {call}, &normal);", f"code = lose(code, NOT(met), MISS, {i});"]
    else:
        limit = f"limits[{deformed.index(i)}]"
        lines += [f"met = meet_{i}(t, &r, {c}, {k1}, {index}, {limit}, {reach}, &normal, &missed);"]
        lines += [f"code = lose(code, NOT(met) & missed, MISS, {i});"]
        lines += [f"code = lose(code, NOT(met), DIVERGED, {i});"]
    for k, (kind, edges, blocks, place) in enumerate(shape.regions):
        count = "" if kind == "circle" else f", {edges}"
        inside = f"in_{kind}(r.position, fixed + {place}{count})"
        lines += [f"met {'' if k == 0 else '&'}= {f'NOT({inside})' if blocks else inside};"]
    if shape.regions:
        lines += [f"code = lose(code, NOT(met), VIGNETTED, {i});"]
    if shape.action == "reflect":
        lines += ["reflect_at_plane(&r);" if shape.bare and shape.plane else "reflect(&r, normal);"]
    elif shape.action == "refract":
        lines += [
            f"met = refract(&r, normal, {ratio});",
            f"code = lose(code, NOT(met), TOTAL_REFLECTION, {i});",
        ]
    return lines
