"""Stores of optical systems are read in blocks, which no number of the report depends on."""

from types import SimpleNamespace

import dask.array
import numpy as np
import pytest
import xarray as xr

from wavequake.report.systems import populations as system_populations

CASES, CHUNK, INSTANTS, FIELDS, WAVES = 37, 5, 8, 3, 2
BENCH = SimpleNamespace(system=SimpleNamespace(primary_wavelength=1))


def random_store(seed=1):
    """Cases of two disturbances, of which one has 3 instants only; some have failed."""
    random = np.random.default_rng(seed)
    over = {"case": CASES, "time": INSTANTS, "field": FIELDS, "wavelength": WAVES}
    short = np.arange(CASES) % 3 == 0

    def series(*dims, scale=1.0):
        values = random.normal(
            1000.0, scale, [*(over[dim] for dim in dims if dim in over), *[2][: "axis" in dims]]
        )
        values[short, 3:] = np.nan
        return (dims, dask.array.from_array(values, chunks=(CHUNK, *values.shape[1:])))

    status = np.ones(CASES, dtype=np.int8)
    status[[0, 4, 36]] = (2, 0, 3)
    time = np.where(short[:, None] & (np.arange(INSTANTS) >= 3), np.nan, np.arange(INSTANTS) * 0.1)
    data = {name: series("case", "time", "field", "wavelength") for name in system_populations._SERIES[:5]}
    data["los_mm"] = series("case", "time", "field", "wavelength", "axis", scale=1e-3)
    counted = ("case", "field", "wavelength")
    data["vignetted"] = (counted, random.integers(0, 9, (CASES, FIELDS, WAVES)).astype(float))
    data["lost"] = (counted, data["vignetted"][1] + random.integers(0, 9, (CASES, FIELDS, WAVES)))
    data["marechal"] = (counted, random.random((CASES, FIELDS, WAVES)))
    coords = {
        "case": np.arange(CASES),
        "disturbance": ("case", np.where(short, "hum", "askew")),
        "time_s": (("case", "time"), time),
        "field": ["a", "b", "c"],
        "status": ("case", status),
    }
    return xr.Dataset(data, coords).reset_coords("status")


@pytest.mark.parametrize("block_bytes", [1, 20_000, 2**26])
def test_every_number_is_that_of_the_whole_series(monkeypatch, block_bytes):
    monkeypatch.setattr(system_populations, "_BLOCK_BYTES", block_bytes)
    dataset = random_store()
    found = system_populations.populations(dataset, BENCH)
    assert [one.name for one in found] == ["hum", "askew"]
    for one, instants in zip(found, (3, INSTANTS), strict=True):
        mine = (dataset["disturbance"] == one.name) & (dataset["status"] == 1)
        light = dataset.isel(wavelength=1, time=slice(instants)).isel(case=np.flatnonzero(mine)).compute()
        np.testing.assert_array_equal(one.cases, light["case"])
        for index, field in enumerate(one.fields):
            here = light.isel(field=index)
            for name, values in (
                ("wfe_rms", field.wfe),
                ("wfe_rms_raw", field.raw),
                ("wfe_change", field.change),
                ("spot_rms", field.spot),
            ):
                np.testing.assert_allclose(values, np.sqrt((here[name] ** 2).mean("time")), rtol=1e-14)
            assert field.strehl_p50 == np.median(here["strehl"])
            assert field.marechal == here["marechal"].mean()
            assert (field.vignetted, field.lost) == (here["vignetted"].max(), here["lost"].max())
            los = here["los_mm"].to_numpy() * 1e3
            squares = ((los - los.mean(axis=(0, 1))) ** 2).sum(axis=2)
            of_mean = los.mean(axis=1).var(axis=0, ddof=1).sum() / len(los)
            np.testing.assert_allclose(field.los.radial, np.sqrt(squares.mean() + of_mean), rtol=1e-9)
            error = squares.mean(axis=1).std(ddof=1) / np.sqrt(len(los)) / (2 * field.los.radial)
            np.testing.assert_allclose(field.los.standard_error, error, rtol=1e-9)
        assert light["wfe_change"].sel(case=one.worst).max() == light["wfe_change"].max()


def test_a_median_is_of_evenly_spaced_instants_where_there_are_many(monkeypatch):
    monkeypatch.setattr(system_populations, "_INSTANTS", 100)
    askew = system_populations.populations(random_store(), BENCH)[1]
    light = random_store().isel(wavelength=1).sel(case=askew.cases).isel(time=slice(None, None, 2))  # 22 x 8
    assert askew.fields[0].strehl_p50 == np.median(light["strehl"].isel(field=0))


def test_blocks_are_whole_chunks_of_bounded_size():
    light = random_store().isel(wavelength=1)
    each = INSTANTS * FIELDS * (5 + 2) * 8
    assert list(system_populations._blocks(light)) == [(0, CASES)]
    assert [last - first for first, last in _bounded(light, 2 * CHUNK * each + 1)] == [10, 10, 10, 7]
    assert [last - first for first, last in _bounded(light, 1)] == [5] * 7 + [2]


def _bounded(light, size):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(system_populations, "_BLOCK_BYTES", size)
        return list(system_populations._blocks(light))


def test_a_store_without_finished_cases_has_empty_populations():
    dataset = random_store()
    dataset["status"][:] = 0
    found = system_populations.populations(dataset, BENCH)
    assert [(one.fields, one.worst) for one in found] == [((), None)] * 2


def summarized(dataset):
    """The store that would keep statistics over time of the same numbers."""
    light = dataset.compute()
    found = {name: light[name] for name in ("vignetted", "lost", "marechal", "status")}
    for name in system_populations._SERIES:
        values = light[name]
        if name == "los_mm":
            values = np.hypot(values.isel(axis=0), values.isel(axis=1))
        last = values.isel(time=-1).where(light["disturbance"] == "askew", values.isel(time=2))
        parts = [
            values.mean("time"),
            np.sqrt((values**2).mean("time")),
            values.min("time"),
            values.max("time"),
        ]
        parts += [values.quantile(0.95, "time").drop_vars("quantile"), last]
        found[name] = xr.concat(parts, "statistic").transpose("case", "statistic", "field", "wavelength")
    return (
        xr.Dataset(found).assign_coords(disturbance=light["disturbance"]).drop_vars("time_s", errors="ignore")
    )


@pytest.mark.parametrize("block_bytes", [1, 2**26])
def test_a_summary_gives_the_same_numbers_as_far_as_it_holds_them(monkeypatch, block_bytes):
    monkeypatch.setattr(system_populations, "_BLOCK_BYTES", block_bytes)
    dataset = random_store()
    whole, short = (system_populations.populations(one, BENCH) for one in (dataset, summarized(dataset)))
    for one, other in zip(whole, short, strict=True):
        assert (one.name, one.worst) == (other.name, other.worst)
        np.testing.assert_array_equal(one.cases, other.cases)
        mine = dataset.isel(case=one.cases, wavelength=1).compute()
        for index, (field, same) in enumerate(zip(one.fields, other.fields, strict=True)):
            for name in ("wfe", "change", "spot", "raw"):
                np.testing.assert_allclose(getattr(same, name), getattr(field, name), rtol=1e-14)
            assert (same.marechal, same.vignetted, same.lost) == (field.marechal, field.vignetted, field.lost)
            here = mine.isel(field=index)
            assert same.strehl_p50 == pytest.approx(np.median(here["strehl"].mean("time")), rel=1e-14)
            squares = 1e6 * (here["los_mm"] ** 2).sum("axis", skipna=False).mean("time").to_numpy()
            assert same.los.radial == pytest.approx(np.sqrt(squares.mean()), rel=1e-12)
            error = squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * same.los.radial)
            assert same.los.standard_error == pytest.approx(error, rel=1e-9)
