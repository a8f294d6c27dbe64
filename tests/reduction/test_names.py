import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.reduction.names import Variant, orders_of, parse
from wavequake.workflows.study import load_study

positive = st.floats(1e-3, 1e5)
weights = st.floats(1e-6, 1e6)


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        ("craigb36", Variant("craigb", 36)),
        ("guyan", Variant("guyan")),
        ("guyan9", Variant("guyan", 9)),
        ("krylov108(200, 450, 700)", Variant("krylov", 108, (200, 450, 700))),
        ("krylov36(150j)", Variant("krylov", 36, (150j,))),
        ("krylov36(150+20j)", Variant("krylov", 36, (150 + 20j,))),
        ("krylov(200*3,450*1)", Variant("krylov", None, (200, 450), (3, 1))),
        ("flbt42(0-1200)", Variant("flbt", 42, bands=((0, 1200, 1),))),
        ("fwbt42(0-400,400-1200*0.1)", Variant("fwbt", 42, bands=((0, 400, 1), (400, 1200, 0.1)))),
        ("pod36", Variant("pod", 36)),
        ("pod36(100)", Variant("pod", 36, (100,))),
    ],
)
def test_names_parse_and_print(name, variant):
    assert parse(name) == variant
    assert str(variant) == name.replace(" ", "")


@given(st.integers(1, 500), st.lists(st.tuples(positive, positive), min_size=1, unique=True))
def test_krylov_names_read_back(order, parts):
    variant = Variant("krylov", order, tuple(complex(*part) for part in parts))
    assert parse(str(variant)) == variant


@given(st.integers(1, 500), st.lists(st.tuples(positive, positive, weights), min_size=1))
def test_band_names_read_back(order, parts):
    variant = Variant("fwbt", order, bands=tuple((low, low + width, weight) for low, width, weight in parts))
    assert parse(str(variant)) == variant


def test_a_bare_method_takes_its_order_apart():
    assert parse("rubin", 36) == parse("rubin36")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("craigh18", "nearest one is 'craigb'"),
        ("ruben36", "nearest one is 'rubin'"),
        ("craigb", "has no order"),
        ("craigb0", "at least 1"),
        ("craigb36(150)", "takes no arguments"),
        ("krylov36", "needs its points"),
        ("krylov36()", "is no frequency"),
        ("krylov36(fast)", "'fast' is no frequency"),
        ("krylov36(-5)", "not negative"),
        ("krylov36(nan)", "finite"),
        ("krylov36(150,150)", "twice"),
        ("krylov36(150*2,300)", "every expansion point"),
        ("krylov36(150*0)", "at least 1"),
        ("flbt42", "needs its bands"),
        ("flbt42(1200)", "is no band"),
        ("krylov36(2e9)", "at most 1e.09 Hz"),
        ("flbt42(0-1e300)", "to 1e.09 Hz at most"),
        ("flbt42(1200-0)", "must rise"),
        ("pod36(0)", "one positive frequency"),
        ("36", "is no name"),
        ("", "is no name"),
    ],
)
def test_bad_names_are_explained(name, message):
    with pytest.raises(UserError, match=message):
        parse(name)


def test_order_and_name_must_agree():
    with pytest.raises(UserError, match="contradict"):
        parse("craigb36", 18)


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("craigb{18:54:18}", ["craigb18", "craigb36", "craigb54"]),
        ("krylov{36:80:36}(200)", ["krylov36(200)", "krylov72(200)"]),
        ("guyan9", ["guyan9"]),
    ],
)
def test_ranges_of_orders(name, names):
    assert orders_of(name) == names


@pytest.mark.parametrize("name", ["craigb{18:9:3}", "craigb{1:9:0}", "craigb{18}", "craigb{1:9999999:1}"])
def test_impossible_ranges_are_told(name):
    with pytest.raises(UserError, match="range"):
        orders_of(name)
    with pytest.raises(UserError, match="range"):
        load_study("mirror-mor", {"reduction.variants": [name]})
