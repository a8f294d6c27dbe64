"""Write the kernel that traces one shape of a system: the calls of ``kernels/sequential.cl``, one by one."""

from dataclasses import dataclass
from functools import lru_cache

from wavequake.kernels.device.program import source

OUTPUTS = ("path", "x", "y", "u", "v", "w_sign")

_LEAVES = {
    "path": "STORE(EITHER(lost, (real)NAN, r.path), out_path + n);",
    "x": "STORE(EITHER(lost, (real)NAN, r.position.x), out_x + n);",
    "y": "STORE(EITHER(lost, (real)NAN, r.position.y), out_y + n);",
    "u": "STORE(EITHER(lost, (real)NAN, r.direction.x / r.length), out_u + n);",
    "v": "STORE(EITHER(lost, (real)NAN, r.direction.y / r.length), out_v + n);",
    "w_sign": "STORE_STATUS(to_integers(EITHER(lost, (real)0.0, EITHER(r.direction.z < 0.0, (real)-1.0, "
    "(real)1.0))), out_w_sign + n);",
}


@dataclass(frozen=True)
class Part:
    """A polynomial or grid that adds to a surface's height.

    ``call`` is the function of ``sequential.cl`` with its sizes, ``size`` counts the coefficients, ``moves``
    tells whether every instant has its own, and ``place`` is where its fixed numbers start, if it has any.
    """

    call: str
    size: int
    moves: bool
    place: int


@dataclass(frozen=True)
class Medium:
    """A medium whose index varies: the element that begins it, its powers, and where its numbers start."""

    first: int
    radial: int
    axial: int
    place: int


@dataclass(frozen=True)
class Bend:
    """An added path, by a number of even powers and a polynomial's degree (-1: none), or a perfect lens.

    ``place`` is where the numbers start.
    """

    even: int
    degree: int
    lens: bool
    place: int


@dataclass(frozen=True)
class Shape:
    """What of an element the kernel's text depends on; ``fixed`` is where its fixed numbers start.

    ``vacuum`` tells whether light comes through an index of 1, by which nothing need be multiplied.
    ``regions`` are (kind, half planes, blocks, where the numbers start); ``even`` is the number of even
    powers and where they start. ``before`` and ``behind`` are media whose index varies. ``form`` is the name
    of a height in closed form, how many numbers it has and where they start; ``whole`` tells whether it is
    all of the surface, which is a plane without it. ``sense`` is that of `Element`.
    """

    fixed: int
    action: str
    plane: bool
    rotates: bool
    vacuum: bool
    even: tuple[int, int]
    parts: tuple[Part, ...]
    regions: tuple[tuple[str, int, bool, int], ...]
    before: Medium | None = None
    behind: Medium | None = None
    form: tuple[str, int, int] | None = None
    whole: bool = False
    bend: Bend | None = None
    sense: int = 0

    @property
    def bare(self) -> bool:
        """Whether the surface is nothing but a conic."""
        return not self.even[0] and not self.parts and self.form is None


@lru_cache(maxsize=256)
def kernel_source(
    shapes: tuple[Shape, ...],
    one_direction: bool,
    one_path: bool,
    sphere: bool,
    outputs: tuple[str, ...],
    turns: int,
) -> str:
    """Return the OpenCL C of a kernel ``sequential`` for elements of the given shapes.

    A work-item traces `turns` vectors of rays, which take turns at every step of every surface.

    Its arguments are: number of rays, fixed numbers, position (3, N), direction (3, N) or (3,), path (N,) or
    (1,), poses, limits, spheres, one array for each part of each element; then `outputs`, status and surface.
    """
    parts = [(i, k, part) for i, shape in enumerate(shapes) for k, part in enumerate(shape.parts)]
    names = [f"part_{i}_{k}" for i, k, _ in parts]
    pointers = [_pointer(name, part) for name, (_, _, part) in zip(names, parts, strict=True)]
    deformed = [i for i, shape in enumerate(shapes) if not shape.bare]
    fields = ["fixed", "poses", "limits", "spheres", *names]
    lines = [source("sequential.cl")]
    lines += [source("forms.h")] if any(shape.form for shape in shapes) else []
    lines += [source("phases.h")] if any(shape.bend for shape in shapes) else []
    lines.append(f"typedef struct {{ __global const double *{', *'.join(fields)}; }} numbers;")
    meet = source("deformed.cl") if deformed else ""
    for i in deformed:
        sense = f"{shapes[i].sense}.0" if shapes[i].sense else "d.z"
        lines += [_height(i, shapes[i]), f"#define NUMBER {i}", f"#define SENSE {sense}", meet]
    lines += [source("gradient.h")] if any(shape.before for shape in shapes) else []
    for i, shape in enumerate(shapes):
        lines += _follow(i, shape, shape.before) if shape.before else []
    for i, shape in enumerate(shapes):
        lines += _element(i, shape, deformed, one_direction and i == 0)
    lines += _start(one_direction, one_path) + _finish(outputs)
    inputs = ["fixed", "position", "direction", "path", "poses", "limits", "spheres", *names]
    arguments = [f"__global const double *{name}" for name in inputs] + _written(outputs)
    moving = [f"poses + instant * {12 * len(shapes)}", f"limits + instant * {len(deformed)}"]
    moving += ["spheres + 4 * instant" if sphere else "spheres", *pointers]
    lines += [
        f"__kernel void sequential(const int rays, {', '.join(arguments)})",
        "{",
        "    ALIGN_STACK;",
        "    const size_t instant = get_global_id(2);",
        "    // The last group overlaps the one before it, so that all lanes are rays.",
        f"    const size_t group = get_global_id(1) * ({turns} * W);",
        "    if (group >= rays)",
        "        return;",
        f"    const size_t n = group + {turns} * W > rays ? rays - {turns} * W : group;",
        "    const size_t out = instant * rays + n;",
        f"    const numbers t = {{fixed, {', '.join(moving)}}};",
    ]
    for k in range(turns):
        lines += [f"    ray r_{k} = start(rays, n + {k} * W, position, direction, path);"]
        lines += [f"    real loss_{k} = 0.0;"]
    for i, shape in enumerate(shapes):
        lines += [f"    const real step_{i}_{k} = reach_{i}(t, &r_{k}, direction);" for k in range(turns)]
        for k in range(0 if shape.bare else turns):
            lines += [f"    const height there_{i}_{k} = height_there_{i}(t, &r_{k}, step_{i}_{k});"]
        for k in range(turns):
            there = "" if shape.bare else f", there_{i}_{k}"
            lines += [f"    loss_{k} = leave_{i}(t, &r_{k}, loss_{k}, step_{i}_{k}{there});"]
    for k in range(turns if sphere else 0):
        index = f"r_{k}.index" if shapes[-1].behind else f"(real)fixed[{shapes[-1].fixed + 4}]"
        met = f"to_sphere(&r_{k}, t.spheres, {index})"
        lines += [f"    loss_{k} = lose_unless({met}, loss_{k}, LOSS(MISS, {len(shapes)}));"]
    results = ", ".join(f"out_{name}" for name in (*outputs, "status", "surface"))
    lines += [f"    finish(r_{k}, loss_{k}, out + {k} * W, {results});" for k in range(turns)]
    return "\n".join([*lines, "}", ""])


def _written(outputs: tuple[str, ...]) -> list[str]:
    written = [f"__global {'char' if name == 'w_sign' else 'double'} *out_{name}" for name in outputs]
    return [*written, "__global char *out_status", "__global char *out_surface"]


def _start(one_direction: bool, one_path: bool) -> list[str]:
    """Return the function that reads rays from number n on."""
    pointers = [f"__global const double *{name}" for name in ("position", "direction", "path")]
    lines = [f"INLINE ray start(const size_t rays, const size_t n, {', '.join(pointers)})", "{", "    ray r;"]
    for k, axis in enumerate("xyz"):
        lines += [f"    r.position.{axis} = {_given('position', k, False)};"]
        lines += [f"    r.direction.{axis} = {_given('direction', k, one_direction)};"]
    lines += [f"    r.path = {_given('path', 0, one_path)};", "    r.length = 1.0;"]
    return [*lines, "    return r;", "}"]


def _finish(outputs: tuple[str, ...]) -> list[str]:
    """Return the function that writes rays from place n on."""
    return [
        f"INLINE void finish(ray r, real loss, const size_t n, {', '.join(_written(outputs))})",
        "{",
        "    const mask lost = loss > 0.0;",
        *("    " + _LEAVES[name] for name in outputs),
        "    STORE_STATUS(status_of(loss), out_status + n);",
        "    STORE_STATUS(surface_of(loss), out_surface + n);",
        "}",
    ]


def _pointer(name: str, part: Part) -> str:
    return f"{name} + instant * {part.size}" if part.moves else name


def _given(name: str, row: int, single: bool) -> str:
    return f"{name}[{row}]" if single else f"LOAD({name} + {row} * rays + n)"


def _ratio(shape: Shape, index: str, ratio: str) -> str:
    """Return the index before an element that refracts over that behind."""
    medium = shape.behind
    if medium:
        place = f"t.fixed + {medium.place}, {medium.radial}, {medium.axial}, r->position"
        return f"{index} / root(squared_index({place}))"
    return f"r->index / t.fixed[{shape.fixed + 4}]" if shape.before else f"(real){ratio}"


def _height(i: int, shape: Shape) -> str:
    """Return the function of an element's height over its conic, with slopes."""
    calls = (
        [f"even_powers(t.fixed + {shape.even[1]}, {shape.even[0]}, x, y, sx, sy)"] if shape.even[0] else []
    )
    calls += [
        part.call.format(array=f"t.part_{i}_{k}", place=f"t.fixed + {part.place}")
        for k, part in enumerate(shape.parts)
    ]
    if shape.form is not None:
        name, count, place = shape.form
        calls.append(f"{name}(t.fixed + {place}, {count}, x, y, sx, sy)")
    lines = [f"INLINE real height_{i}(numbers t, real x, real y, real *sx, real *sy)", "{"]
    lines += ["    *sx = 0.0;", "    *sy = 0.0;", f"    real height = {calls[0]};"]
    lines += [f"    height += {call};" for call in calls[1:]]
    return "\n".join([*lines, "    return height;", "}"])


def _follow(i: int, shape: Shape, medium: Medium) -> list[str]:
    """Return the functions that follow rays to an element through a medium whose index varies."""
    lines = [f"INLINE real sag_{i}(numbers t, real x, real y, real *sx, real *sy)", "{"]
    if shape.plane or shape.whole:
        lines += ["    real sag = 0.0;", "    *sx = *sy = 0.0;"]
    else:
        c, k1 = (f"t.fixed[{shape.fixed + k}]" for k in range(2))
        lines += [
            f"    const real square = x * x + y * y, edge = root(1.0 - ({c} * {c} * {k1}) * square);",
            f"    real sag = {c} * square / (1.0 + edge);",
            f"    *sx = {c} * x / edge;",
            f"    *sy = {c} * y / edge;",
        ]
    if not shape.bare:
        lines += [
            "    real steep_x, steep_y;",
            f"    sag += height_{i}(t, x, y, &steep_x, &steep_y);",
            "    *sx += steep_x;",
            "    *sy += steep_y;",
        ]
    numbers = {"NUMBER": i, "FIRST": medium.first, "MEDIUM": medium.place}
    numbers |= {"RADIAL": medium.radial, "AXIAL": medium.axial}
    defines = [f"#define {name} {value}" for name, value in numbers.items()]
    return [*lines, "    return sag;", "}", *defines, source("gradient.cl")]


def _element(i: int, shape: Shape, deformed: list[int], together: bool) -> list[str]:
    """Return the functions of one element: the step to its conic, and all that follows.

    `together` tells whether all rays arrive in the kernel's own ``direction``. The element's fixed numbers
    are c, k1, index before, ratio, index, reach.
    """
    c, k1, index, ratio, _, reach = (f"t.fixed[{shape.fixed + k}]" for k in range(6))
    index = "r->index" if shape.before else "(real)1.0" if shape.vacuum else f"(real){index}"
    flat = shape.bare and shape.plane
    step = "plane_step(r)" if flat else f"conic_step(r->position, r->direction, {c}, {k1})"
    if shape.sense and not flat:
        step = f"conic_step_in_sense(r->position, r->direction, {c}, {k1}, (real){shape.sense}.0)"
    pose = f"shift(r, t.poses + {12 * i});"
    if shape.rotates and together:
        pose = f"rotate_together_and_{pose[:-2]}, direction);"
    elif shape.rotates:
        pose = f"rotate_and_{pose}"
    reaches = [
        f"INLINE real reach_{i}(const numbers t, ray *r, __global const double *direction)",
        "{",
        f"    {pose}",
        *([f"    follow_{i}(t, r);"] if shape.before else []),
        f"    return {step};",
        "}",
    ]
    lines = []
    if shape.bare:
        call = f"meet_plane(r, step, {index}" if flat else f"meet_conic(r, step, {c}, {k1}, {index}"
        lines += [f"loss = lose_unless({call}, &normal), loss, LOSS(MISS, {i}));"]
    else:
        around = "0.0, 1.0" if shape.whole else f"{c}, {k1}"
        surface = f"{around}, {index}, t.limits[{deformed.index(i)}], {reach}"
        lines += [f"loss = larger(meet_{i}(t, r, step, there, {surface}, &normal), loss);"]
    for k, (kind, edges, blocks, place) in enumerate(shape.regions):
        count = "" if kind == "circle" else f", {edges}"
        inside = f"in_{kind}(r->position, t.fixed + {place}{count})"
        lines += [f"met {'' if k == 0 else '&'}= {f'NOT({inside})' if blocks else inside};"]
    if shape.regions:
        lines += [f"loss = lose_unless(met, loss, LOSS(VIGNETTED, {i}));"]
    if shape.bend is not None:
        lines += _bend(i, shape, shape.bend, index)
    elif shape.action == "reflect":
        lines += ["reflect_at_plane(r);" if flat else "reflect(r, normal);"]
    elif shape.action == "refract":
        lines += [
            f"met = refract(r, normal, {_ratio(shape, index, ratio)});",
            f"loss = lose_unless(met, loss, LOSS(TOTAL_REFLECTION, {i}));",
        ]
    there = "" if shape.bare else ", const height there"
    head = [f"INLINE real leave_{i}(const numbers t, ray *r, real loss, const real step{there})", "{"]
    head += ["    triple normal;", "    mask met;"]
    return [*reaches, *head, *("    " + line for line in lines), "    return loss;", "}"]


def _bend(i: int, shape: Shape, bend: Bend, before: str) -> list[str]:
    """Return the statements that add an element's path and bend the rays."""
    after = f"(real)t.fixed[{shape.fixed + 4}]"
    if bend.lens:
        return [f"focus(r, {before}, {after}, t.fixed + {bend.place});"]
    where = "r->position.x, r->position.y, &bend_x, &bend_y"
    lines = ["real bend_x = 0.0, bend_y = 0.0;"]
    if bend.even:
        lines += [f"r->path += even_powers(t.fixed + {bend.place}, {bend.even}, {where});"]
    if bend.degree >= 0:
        lines += [f"r->path += monomials(t.fixed + {bend.place + bend.even}, {bend.degree}, {where});"]
    sense = "-1.0" if shape.action == "reflect" else "1.0"
    return [
        *lines,
        f"met = diffract(r, normal, {before}, {after}, bend_x, bend_y, {sense});",
        f"loss = lose_unless(met, loss, LOSS(NO_ORDER, {i}));",
    ]
