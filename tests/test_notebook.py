"""What notebooks show: drawings, progress, errors in a sentence."""

import io
import subprocess
import sys
from contextlib import redirect_stderr

import wavequake as wq
from wavequake import notebook
from wavequake.errors import StoreDamageError


def test_a_notebook_shows_drawings_and_says_errors_in_a_sentence():
    """In a real IPython shell, as a kernel has it."""
    code = (
        "from IPython.core.interactiveshell import InteractiveShell\n"
        "shell = InteractiveShell.instance()\n"
        "shell.run_cell('import wavequake as wq')\n"
        "shell.run_cell('wq.load_system(\"nothing\")')\n"
        "for what in ('wq.load_system(\"euv\")', 'wq.load_study(\"tmt18-history\")', 'wq.draw(\"euv\")'):\n"
        "    made, _ = shell.display_formatter.format(shell.ev(what))\n"
        "    print(sorted(made), '<svg' in made.get('text/html', made.get('image/svg+xml', '')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.count("Error: There is no optical system 'nothing'") == 1
    assert "Traceback" not in done.stdout + done.stderr
    lines = done.stdout.strip().splitlines()[-3:]
    assert lines == [
        "['text/html', 'text/plain'] True",
        "['text/html', 'text/plain'] True",
        "['image/svg+xml', 'text/plain'] True",
    ]


def test_what_a_notebook_cannot_draw_it_still_names():
    said = io.StringIO()
    with redirect_stderr(said):
        notebook.explain(None, StoreDamageError, StoreDamageError("a chunk is torn"), None)
    assert said.getvalue() == "Damaged store: a chunk is torn\n"
    flat = wq.load_model("circular", core=2, rings=2)
    broken = type(flat)(**{**vars(flat), "surface_nodes": flat.surface_nodes[:2]})
    assert "span no area" in notebook.shown(broken)
    assert notebook.bar(3, 12, 1) == '<progress value="3" max="12"></progress> 3/12 cases, 1 quarantined'
    with notebook.progress_bar() as progress:
        assert progress is None
