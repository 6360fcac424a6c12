"""Compiled kernels are kept on disk, and made anew when any file beside theirs has changed."""

import subprocess
import sys

import pytest

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")

INNER = "from torchtrack.backends.numba.compiler import kernel\n\n\n@kernel()\ndef inner(x):\n    return x + {more}\n"
OUTER = "from inner import inner\nfrom torchtrack.backends.numba.compiler import kernel\n\n\n@kernel()\ndef outer(x):\n    return 10 * inner(x)\n"
ASK = "import sys; sys.path.insert(0, sys.argv[1]); from outer import outer; print(outer(1), sum(outer.stats.cache_hits.values()))"


def asked(folder):
    done = subprocess.run([sys.executable, "-c", ASK, str(folder)], capture_output=True, text=True, check=True, timeout=300)
    return [int(word) for word in done.stdout.split()]


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path):
    (tmp_path / "inner.py").write_text(INNER.format(more=1))
    (tmp_path / "outer.py").write_text(OUTER)
    assert asked(tmp_path) == [20, 0]
    assert asked(tmp_path) == [20, 1]
    (tmp_path / "inner.py").write_text(INNER.format(more=2))
    assert asked(tmp_path) == [30, 0]


def test_kernels_compile_where_nothing_can_be_cached(monkeypatch):
    from torchtrack.backends.numba import compiler

    compile_function = compiler.numba.njit

    def njit(function, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return compile_function(function, **options)

    monkeypatch.setattr(compiler.numba, "njit", njit)

    @compiler.kernel()
    def double(value):
        return 2 * value

    assert double(21) == 42
