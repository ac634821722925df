"""Compiles the page code's arithmetic where a C compiler and the headers of Python are; elsewhere numpy does it.

All else stands in pyproject.toml. With LIGHTPAGE_PAGE_CODE=compiled in the environment, failing to compile is an error.
With LIGHTPAGE_PAGE_CODE=numpy nothing is compiled. A wheel without what is compiled is one for every system.
"""

import os
import sys
import sysconfig
import tempfile
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# isort: split
from distutils.ccompiler import new_compiler  # setuptools brings it, once imported
from distutils.sysconfig import customize_compiler

FOLDER = "lightpage/codec/compiled"
LIMITED_API = "0x030B0000"
"""Of Python 3.11: one build serves it and all later ones."""
FLAGS = ["-std=c99", "-O3", "-g0", "-ffp-contract=off", "-fno-trapping-math", "-fno-math-errno", "-fvisibility=hidden"]
"""Of compilers that take gcc's: no fused operations, so that every processor gives the same bits."""


class BuildExtension(build_ext):
    """Gives gcc and clang their flags; another compiler gets none."""

    def build_extensions(self) -> None:
        """Compile."""
        if self.compiler.compiler_type != "msvc":
            for extension in self.extensions:
                extension.extra_compile_args = FLAGS
                extension.extra_link_args = ["-Wl,-s"] if sys.platform == "linux" else []
                extension.libraries = ["m"]
        super().build_extensions()


def compiles() -> bool:
    """Return whether a C compiler and the headers of Python are here, as a wheel's name must say before it is built."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "tried.c")
        source.write_text("#include <Python.h>\n", "utf-8")
        compiler = new_compiler()
        customize_compiler(compiler)
        try:
            headers = [sysconfig.get_path("include"), sysconfig.get_path("platinclude")]
            compiler.compile([str(source)], output_dir=folder, include_dirs=headers)
        except Exception:  # each compiler's class has errors of its own
            return False
    return True


WANTED = os.environ.get("LIGHTPAGE_PAGE_CODE")
PAGE_CODE = Extension(
    "lightpage.codec.compiled.page_code",
    [f"{FOLDER}/page_code.c"],
    depends=[f"{FOLDER}/kernels.h"],
    define_macros=[("Py_LIMITED_API", LIMITED_API)],
    py_limited_api=True,
    optional=WANTED != "compiled",
)

# A free-threaded Python has no stable ABI: numpy does it there.
if WANTED == "numpy" or sysconfig.get_config_var("Py_GIL_DISABLED") or not (WANTED == "compiled" or compiles()):
    setup()
else:
    setup(
        ext_modules=[PAGE_CODE],
        cmdclass={"build_ext": BuildExtension},
        options={"bdist_wheel": {"py_limited_api": "cp311"}},
    )
