"""What no study, command or documented call reaches is not in the package."""

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "pipeline" / "wavequake"
# Calls and decorators by which commands, kinds and parts make themselves known.
MAKE_KNOWN = {"add", "add_typer", "callback", "command", "register"}
PLAIN = {"property", "cached_property", "classmethod", "staticmethod", "override"}

# Physics that tests compare other ways with, or that no study opens yet, are counted by the room:
# nothing joins them unseen. Upper rooms have none.
WAITING = {
    "control": 11,
    "firmware": 1,
    "imaging": 6,
    "kernels": 3,
    "mechanics": 38,
    "optics": 10,
    "reduction": 3,
}
# Dask's workers look for a function of this name in what is preloaded.
BY_NAME = {"dask_setup"}


class Module:
    """The definitions of a module, with what each of them names."""

    def __init__(self, name, tree):
        self.name = name
        self.aliases = aliases_of(tree)
        parts = [part for node in tree.body for part in flat(node)]
        self.own = {name for node in parts for name in names_of(node)}
        self.uses, self.roots = {}, []
        for node in parts:
            self.define(node)

    def define(self, node):
        names = names_of(node)
        if not names:
            if not isinstance(node, (ast.Import, ast.ImportFrom)):
                self.roots.append(self.named_in(node))
            return
        mentioned = [node]
        if isinstance(node, ast.ClassDef):
            foreign = any(not self.is_ours(base) for base in node.bases)  # which calls what it knows
            methods = [one for one in node.body if is_method(one) and not foreign]
            mentioned = [one for one in ast.iter_child_nodes(node) if one not in methods]
            for one in methods:
                self.uses[f"{node.name}.{one.name}"] = self.named_in(one)
        found = [self.named_in(one) for one in mentioned]
        total = (
            frozenset().union(*(full for full, _ in found)),
            frozenset().union(*(loose for _, loose in found)),
        )
        self.uses |= dict.fromkeys(names, total)
        if makes_itself_known(node) or BY_NAME & set(names) or any(one.startswith("__") for one in names):
            self.roots.append(({f"{self.name}.{one}" for one in names}, set()))

    def is_ours(self, base):
        words = [one.id for one in ast.walk(base) if isinstance(one, ast.Name)]
        return any(
            one in self.own or self.aliases.get(one, "").startswith(("wavequake.", "typing.", "abc."))
            for one in words
        )

    def named_in(self, node):
        """Return full names of what a node mentions, and attributes and words of which nobody knows whose."""
        return mentions(node, self.aliases, {one: f"{self.name}.{one}" for one in self.own})


def flat(node):
    if isinstance(node, ast.If):
        return [*node.body, *node.orelse]
    if isinstance(node, ast.Try):
        return [*node.body, *node.orelse, *(one for handler in node.handlers for one in handler.body)]
    return [node]


def names_of(node):
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
    return [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]


def is_method(node):
    """Of a class that is called by its name alone; validators and the like are a part of their class."""
    if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or node.name.startswith("__"):
        return False
    words = {
        getattr(part, "id", getattr(part, "attr", ""))
        for one in node.decorator_list
        for part in ast.walk(one)
    }
    return words <= PLAIN | {""}


def makes_itself_known(node):
    marks = getattr(node, "decorator_list", [])
    if isinstance(node, (ast.Assign, ast.AnnAssign)):
        marks = [one.func for one in ast.walk(node) if isinstance(one, ast.Call)]
    return bool(
        MAKE_KNOWN
        & {getattr(part, "attr", getattr(part, "id", "")) for one in marks for part in ast.walk(one)}
    )


def aliases_of(tree):
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names}
        elif isinstance(node, ast.Import):
            found |= {
                one.asname or one.name.split(".")[0]: (one.asname and one.name) or one.name.split(".")[0]
                for one in node.names
            }
    return found


def mentions(tree, aliases, own):
    full, loose, known = set(), set(), own | aliases
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            loose.add(node.attr)
            text = ast.unparse(node)
            base, _, rest = text.partition(".")
            if base in known and re.fullmatch(r"[\w.]+", rest):
                full.add(f"{known[base]}.{rest}")
        elif isinstance(node, ast.Name) and node.id in known:
            full.add(known[node.id])
        elif isinstance(node, ast.keyword) and node.arg:
            loose.add(node.arg)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) < 80:
            full |= {known[word] for word in re.findall(r"\w+", node.value) if word in known}  # annotations
            full |= {node.value} if "." in node.value else set()
            loose |= {node.value}
    return full, loose


def parsed():
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        yield name, Module(name, ast.parse(path.read_text(encoding="utf-8")))


def documented():
    """Yield what the pages' snippets and the programs that make the documentation mention."""
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        yield set(re.findall(r":: (wavequake[\w.]+)", text)), set()
        for block in re.findall(r"^```python\n(.*?)^```", text, flags=re.M | re.S):
            tree = ast.parse(block)
            aliases = {"wq": "wavequake", **aliases_of(tree)}
            yield set(aliases.values()), set()
            yield mentions(tree, aliases, {})
    for path in (ROOT / "docs").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        yield mentions(tree, aliases_of(tree), {})
    for path in PACKAGE.rglob("*.j2"):
        yield set(), set(re.findall(r"\w+", path.read_text(encoding="utf-8")))


def unreached(modules, roots):
    """Return the definitions that none of the roots leads to, by module and name."""
    places = {f"{name}.{one}": (name, one) for name, module in modules.items() for one in module.uses}
    by_attribute = defaultdict(set)
    for name, module in modules.items():
        for one in module.uses:
            by_attribute[one.rpartition(".")[2]].add((name, one))

    def place_of(full):
        """Return where a name is defined, which other modules may pass on."""
        for _ in range(4):
            if full in places:
                return places[full]
            home = full
            while home not in modules and "." in home:
                home = home.rpartition(".")[0]
            first, _, rest = full[len(home) + 1 :].partition(".")
            if home not in modules:
                return None
            if f"{home}.{first}" in places:
                return places[f"{home}.{first}"]
            if first not in modules[home].aliases:
                return None
            full = f"{modules[home].aliases[first]}.{rest}".rstrip(".")
        return None

    reached, words, loaded, todo = set(), set(), set(), list(roots)
    while todo:
        full = set().union(*(one for one, _ in todo))
        words |= set().union(*(one for _, one in todo))
        loaded |= {start + one for one in full | words for start in STARTS} & modules.keys()
        fresh = {place for one in full if (place := place_of(one))}
        for name, one in {place for word in words for place in by_attribute[word]}:
            holder = one.rpartition(".")[0]
            if (name, holder) in reached if holder else name in loaded:
                fresh.add((name, one))
        fresh -= reached
        reached |= fresh
        todo = [modules[name].uses[one] for name, one in fresh]
    return set(places.values()) - reached


# What text names modules by, which are imported when they are asked for.
STARTS = ("", "wavequake.report.")


def test_what_nothing_reaches_is_gone():
    modules = dict(parsed())
    roots = [root for module in modules.values() for root in module.roots]
    roots += [(set(modules["wavequake"].aliases.values()), set()), *documented()]
    roots.append(({f"wavequake.plot.{one}" for one in modules["wavequake.plot"].own}, set()))
    lost = unreached(modules, roots)
    homes = {name for name, one in lost if one.rpartition(".")[2][0] != "_"}
    # What is private goes with what it serves.
    names = [f"{name}.{one}" for name, one in lost if "._" not in f".{one}" or name not in homes]
    rooms = Counter(one.split(".")[1] for one in names)
    assert rooms == WAITING, "\n".join(sorted(names))
