"""Say where the time of a store's chunks went, from its journal."""

from pathlib import Path

from wavequake.campaign.stopwatch import CPU
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.objects import location
from wavequake.campaign.store.store import JOURNAL, done_records, read_manifest
from wavequake.workflows.kinds import find_kind


def profile(path: Path | str) -> dict[str, str]:
    """Say where the time of a store's chunks went, from its journal.

    That is the share of each kind of work by the clock and its processor time, rates, the time and launches
    of every OpenCL kernel by the device's clock, and what was copied to and from a device that has memory of
    its own.

    Raises
    ------
    UserError
        If there is no store at `path`.
    """
    manifest = read_manifest(path)
    records = done_records(manifest, read_journal(location(path) / JOURNAL))
    seconds: dict[str, float] = {}
    for record in records.values():
        for name, value in record.timings.items():
            seconds[name] = seconds.get(name, 0.0) + value
    total = seconds.pop("compute_s", 0.0) + seconds.get("write_s", 0.0)
    if not total:
        return {"profile": "nothing was computed yet"}
    seconds["write"] = seconds.pop("write_s", 0.0)
    cpu, kernels, launches, copied = (
        {name.removeprefix(kind): seconds.pop(name) for name in sorted(seconds) if name.startswith(kind)}
        for kind in (CPU, "kernel ", "launches ", "bytes ")
    )
    seconds["rest"] = total - sum(seconds.values())
    lines = {
        name: f"{value:8.2f} s  {value / total:6.1%}" + (f"  {cpu[name]:8.2f} s CPU" if name in cpu else "")
        for name, value in seconds.items()
    }
    work = find_kind(manifest.workflow).work(manifest.study, sum(last - first for first, last in records))
    rates = {
        f"{name} rate": f"{count / seconds[name] / 1e6:8.1f} M {unit}/s"
        for name, (count, unit) in work.items()
        if seconds.get(name)  # a store of an earlier version may lack it
    }
    ran = {
        f"kernel {name}": f"{value:8.2f} s  {value / total:6.1%}  {launches[name]:.0f} x "
        f"{1e3 * value / launches[name]:.3g} ms"
        for name, value in sorted(kernels.items(), key=lambda item: -item[1])
    }
    moved = {f"copied {way}": f"{1e-6 * count:8.1f} MB" for way, count in copied.items()}
    spent = f"  100.0%  {cpu['chunks']:8.2f} s CPU" if "chunks" in cpu else ""
    return {**lines, "all chunks": f"{total:8.2f} s{spent}", **rates, **ran, **moved}
