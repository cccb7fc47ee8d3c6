# SPDX-License-Identifier: Apache-2.0
"""The package itself: its annotations and texts agree with the module, and its document is true."""

import ast
import inspect
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time
import unittest

import dssm
import numpy as np
from dssm import _dssm
from support import BUILD, PATIENT_S, SOURCE, Case, Daemon, await_that

IGNORED = {"__doc__", "__module__", "__new__", "__init__", "__repr__", "__str__", "__hash__", "__weakref__", "__dict__"}


def annotated() -> tuple[dict[str, set[str]], set[str]]:
    """Of _dssm.pyi: the members of each class, and the names of functions and constants."""
    tree = ast.parse((pathlib.Path(dssm.__file__).parent / "_dssm.pyi").read_text())
    classes: dict[str, set[str]] = {}
    others = set()
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            members = {each.name for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
            for base in node.bases:
                members |= classes[base.id]
            classes[node.name] = members
        elif isinstance(node, ast.FunctionDef):
            others.add(node.name)
        elif isinstance(node, ast.AnnAssign) and not isinstance(node.annotation, ast.Name | ast.Attribute) or (
                isinstance(node, ast.AnnAssign) and node.value is None):
            others.add(node.target.id)
    return classes, others


class Package(unittest.TestCase):
    def test_annotations_name_what_there_is(self):
        classes, others = annotated()
        classes.pop("_Reads")
        real = {name: value for name, value in vars(_dssm).items() if not name.startswith("__") or name == "__version__"}
        self.assertEqual(set(classes), {name for name, value in real.items() if inspect.isclass(value)})
        self.assertEqual(others, {name for name, value in real.items() if not inspect.isclass(value)})
        for name, members in classes.items():
            with self.subTest(name=name):
                own = {each for each in vars(real[name]) if each not in IGNORED and not each.startswith("_pybind11")}
                self.assertEqual(members - IGNORED, own)

    def test_everything_has_a_text(self):
        for name in dssm.__all__:
            value = getattr(dssm, name)
            if isinstance(value, int | str):
                continue
            with self.subTest(name=name):
                self.assertTrue(inspect.getdoc(value))
            for member, what in vars(value).items() if inspect.isclass(value) else ():
                if not member.startswith("_") and not isinstance(what, str):
                    with self.subTest(name=f"{name}.{member}"):
                        self.assertTrue(inspect.getdoc(what))

    def test_all_is_complete(self):
        public = {name for name in vars(dssm) if not name.startswith("_")} - {"Sequence", "Any"}
        self.assertEqual(public | {"__version__"}, set(dssm.__all__))

    def test_all_codes_have_an_exception(self):
        header = (SOURCE / "core/include/dssm/error.hpp").read_text()
        codes = set(re.findall(r"^  (\w+),  +//", header, re.MULTILINE))
        header = (SOURCE / "core/include/dssm/sample.hpp").read_text()
        statuses = set(re.findall(r"^    (\w+),", header.partition("ReadStatus")[2].partition("};")[0], re.MULTILINE))
        self.assertIn("not_found", codes)
        self.assertIn("too_old", statuses)
        for code in codes | statuses - {"ok"}:
            with self.subTest(code=code):
                self.assertEqual(dssm._errors.by_code(code).code, code)
                self.assertEqual(dssm._errors.by_code(code).__module__, "dssm")

    def test_the_installed_package_is_complete(self):
        """Installs into a folder, and imports the package from it."""
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(["meson", "install", "-C", BUILD, "--no-rebuild", "--tags", "python-runtime", "--destdir",
                            folder, "--quiet"], check=True, stdout=subprocess.DEVNULL)
            found = list(pathlib.Path(folder).glob("**/dssm/__init__.py"))
            self.assertEqual(len(found), 1)
            self.assertIn("dist-packages/dssm", str(found[0]))
            package = found[0].parent
            self.assertTrue((package / "py.typed").exists() and (package / "_dssm.pyi").exists())
            imported = subprocess.run(
                ["/usr/bin/python3", "-c", "import dssm; print(dssm.__file__, dssm.__version__)"], capture_output=True, text=True,
                env=os.environ | {"PYTHONPATH": str(package.parent)})
            self.assertEqual(imported.stdout.split(), [str(found[0]), dssm.__version__], imported.stderr)


class Document(Case):
    """docs/python.md: each of its blocks runs."""

    def blocks(self):
        text = (SOURCE / "docs/python.md").read_text()
        return re.findall(r"<!-- file: (\S+) -->\n```python\n(.*?)```", text, re.DOTALL), text

    def test_each_block_is_a_file(self):
        blocks, text = self.blocks()
        self.assertEqual(len(blocks), text.count("```python"))

    def test_the_programs_run(self):
        """In the order of the document, in one folder; writer.py beside those that read."""
        blocks, _ = self.blocks()
        with tempfile.TemporaryDirectory() as folder:
            for name, text in blocks:
                (pathlib.Path(folder) / name).write_text(text)
            writer = subprocess.Popen([sys.executable, "writer.py"], cwd=folder, text=True)
            try:
                await_that(lambda: [s for s in self.session.streams() if s.name == "climate:0@pc1" and s.newest_tid > 3])
                for name, _ in blocks:
                    if name == "writer.py":
                        continue
                    with self.subTest(name=name):
                        done = subprocess.run([sys.executable, name], cwd=folder, capture_output=True, text=True,
                                              timeout=2 * PATIENT_S)
                        self.assertEqual((done.returncode, done.stderr), (0, ""))
                        self.assertIn("degrees", done.stdout)
            finally:
                writer.terminate()
                writer.wait()


# In place of matplotlib, which need not be installed: writes how many points are drawn.
MATPLOTLIB = {"__init__.py": "def use(name): pass", "pyplot.py": """
class Axes:
    def __init__(self): self.points = {}
    def plot(self, x, y, label): self.points[label] = len(x)
    def clear(self): self.points = {}
    def set(self, **texts): pass
    def legend(self, loc): pass
class Figure:
    def __init__(self, axes): self.axes = axes
    def savefig(self, file): open(file, "w").write(str(self.axes.points))
def subplots():
    axes = Axes()
    return Figure(axes), axes
"""}


class Example(Case):
    def test_plot_of_another_host(self):
        """The past, which is on its way when the example begins to draw."""
        pc2 = Daemon("pc2", [self.daemon])
        self.addCleanup(pc2.close)
        with self.session.create("far", np.dtype([("x", "f8"), ("rest", "u1", 65536)]), depth=512, cycle=0.01) as writer, \
                tempfile.TemporaryDirectory() as folder:
            (pathlib.Path(folder) / "matplotlib").mkdir()
            for name, text in MATPLOTLIB.items():
                (pathlib.Path(folder) / "matplotlib" / name).write_text(text)
            sample = np.zeros((), writer.dtype)
            now = time.time_ns()
            for i in range(300):
                writer.write(sample, now + i * 1_000_000)
            drawn = pathlib.Path(folder) / "drawn"
            plot = subprocess.run(
                [sys.executable, SOURCE / "docs/examples/python/plot_stream.py", "far@pc1", "--seconds", "0.29", "--out", drawn],
                stderr=subprocess.PIPE, text=True, timeout=2 * PATIENT_S,
                env=os.environ | {"DSSM_SOCKET": pc2.socket_path, "PYTHONPATH": f"{folder}:{os.environ['PYTHONPATH']}"})
            self.assertEqual((plot.returncode, plot.stderr), (0, ""))
            self.assertEqual(drawn.read_text(), "{'x': 291}")

    def test_plot(self):
        """The example plots a stream into a file; without matplotlib it says what to install."""
        with self.session.create("wave", "f8", depth=1024, cycle=0.01) as writer, tempfile.TemporaryDirectory() as folder:
            picture = pathlib.Path(folder) / "wave.png"
            plot = subprocess.Popen(
                [sys.executable, SOURCE / "docs/examples/python/plot_stream.py", "wave", "--seconds", "0.5", "--out", picture],
                stderr=subprocess.PIPE, text=True)

            def ended():
                writer.write(1.0)
                return plot.poll() is not None

            await_that(ended)
            error = plot.communicate()[1]
            if plot.returncode == 0:
                self.assertEqual(picture.read_bytes()[:4], b"\x89PNG")
            else:
                self.assertIn("apt-get install python3-matplotlib", error)
