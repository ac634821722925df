"""Compiles the page code's arithmetic where a C compiler is; without one, numpy does it.

All else stands in pyproject.toml.
"""

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

LIMITED_API = 0x030B0000
"""Of Python 3.11: one build serves it and all later ones."""
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fno-trapping-math", "-fno-math-errno", "-fvisibility=hidden"]
"""Of compilers that take gcc's: no fused operations, so that every processor gives the same bits."""


class BuildExtension(build_ext):
    """Gives gcc and clang their flags; another compiler gets none."""

    def build_extensions(self) -> None:
        """Compile."""
        if self.compiler.compiler_type != "msvc":
            for extension in self.extensions:
                extension.extra_compile_args = FLAGS
                extension.libraries = ["m"]
        super().build_extensions()


setup(
    ext_modules=[
        Extension(
            "lightpage.codec.compiled.page_code",
            ["lightpage/codec/compiled/page_code.c"],
            define_macros=[("Py_LIMITED_API", hex(LIMITED_API))],
            py_limited_api=True,
            optional=True,
        )
    ],
    cmdclass={"build_ext": BuildExtension},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
