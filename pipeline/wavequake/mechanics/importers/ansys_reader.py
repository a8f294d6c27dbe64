"""Run ansys-mapdl-reader on one file, in a process of its own: ``python ansys_reader.py FILE OUT BYTES``.

The library believes what a file says, and a damaged one ends its process. OUT becomes an .npz file of the
degrees of freedom and both matrices of a .full file, or of the nodes and displacements of an .rst file (or
temperatures, where a fourth word says so: to look for them ends the process in some files without them);
where there is none, the last line that is printed says why.
"""

import os
import sys
import time
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]

from wavequake.posix import resource

_CPU_S, _CPU_S_PER_BYTE = 5.0, 1e-6  # a hundred times what a file takes that is sound


def read(file: str) -> dict[str, Any]:
    """Return ``dofs`` and, of ``stiffness`` and ``mass``, the rows, columns, values and size."""
    from ansys.mapdl import reader
    from scipy.sparse import coo_array

    dofs, *matrices = reader.read_binary(file).load_km(as_sparse=True, sort=False)
    found = {"dofs": np.asarray(dofs, dtype=np.int64)}
    for name, matrix in zip(("stiffness", "mass"), matrices, strict=True):
        if matrix is None:
            raise ValueError(f"it holds no {name}")
        sparse = coo_array(matrix)
        rows, columns = sparse.coords
        found[f"{name}_rows"], found[f"{name}_columns"] = rows.astype(np.int64), columns.astype(np.int64)
        found[f"{name}_values"] = np.asarray(sparse.data, dtype=np.float64)
        found[f"{name}_size"] = np.array(matrix.shape[0])
    return found


def read_results(file: str, what: str = "displacements") -> dict[str, Any]:
    """Return kind of analysis, values of the steps, nodes, and displacements (steps, nodes, 3).

    Or ``temperatures`` (steps, nodes), of a thermal analysis or those that load a structure.
    """
    from ansys.mapdl import reader

    results = reader.read_binary(file)
    ask = results.nodal_temperature if what == "temperatures" else results.nodal_displacement
    labels, _ = ask(0)
    found = [ask(step)[1] for step in range(results.n_results)]
    return {
        "analysis": np.array(results._resultheader["kan"]),
        "values": np.array(results.time_values, dtype=np.float64),
        "labels": np.asarray(labels, dtype=np.int64),
        what: np.array([one[:, :3] if one.ndim == 2 else one for one in found], dtype=np.float64),
        "node_numbers": np.asarray(results.mesh.nnum, dtype=np.int64),
        "points": np.array(results.mesh.nodes, dtype=np.float64)[:, :3],
    }


def main(file: str, out: str, most: int, wanted: str) -> None:
    """Read a file with at most so many bytes of memory beyond those of the libraries, in bounded time."""
    try:
        import scipy.sparse  # noqa: F401 - takes memory of its own

        used = psutil.Process().memory_info().data
        for what, limit in ((resource.RLIMIT_DATA, used + most), (resource.RLIMIT_CORE, 0)):
            resource.setrlimit(what, (limit, resource.getrlimit(what)[1]))
        seconds = time.process_time() + _CPU_S + _CPU_S_PER_BYTE * os.path.getsize(file)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), resource.getrlimit(resource.RLIMIT_CPU)[1]))
        np.savez(out, **(read_results(file, wanted) if wanted else read(file)))
    except Exception as error:  # the library raises whatever its parser trips over
        print(str(error) or type(error).__name__)
        sys.exit(1)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4])
