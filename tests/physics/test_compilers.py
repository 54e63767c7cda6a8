"""Libraries that are built once."""

import ctypes

import pytest

from clothjax.physics import compilers

needs_a_compiler = pytest.mark.skipif(compilers.compiler("C++") is None, reason="needs a C++ compiler")


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """What is compiled, with a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run, linked = compilers.run, []

    def recorded(language, arguments):
        if "-shared" in arguments:
            linked.append(language)
        return run(language, arguments)

    monkeypatch.setattr(compilers, "run", recorded)
    return linked


def seven(library):
    return ctypes.CDLL(str(library)).seven()


@needs_a_compiler
def test_a_library_is_built_again_where_it_would_be_another(commands, tmp_path, monkeypatch):
    source, header = tmp_path / "seven.cc", tmp_path / "seven.h"
    source.write_text('#include "seven.h"\nextern "C" int seven() { return SEVEN; }\n')
    header.write_text("#define SEVEN 7\n")
    first = compilers._library(source, None)
    assert seven(first) == 7 and compilers._library(source, None) == first and len(commands) == 1
    assert list((tmp_path / "cache" / "clothjax").iterdir()) == [first]
    header.write_text("#define SEVEN 8\n")
    second = compilers._library(source, None)
    assert seven(second) == 8 and seven(first) == 7 and len(commands) == 2
    monkeypatch.setattr(compilers, "FLAGS", ("-O1",))
    assert compilers._library(source, None) not in (first, second) and len(commands) == 3
    source.write_text("not C++")
    with pytest.raises(OSError, match=r"failed: (.|\n)*seven\.cc"):
        compilers._library(source, None)
    assert len(list((tmp_path / "cache" / "clothjax").iterdir())) == 3


@needs_a_compiler
def test_a_library_that_cannot_be_kept_is_built_for_the_process(commands, tmp_path):
    (tmp_path / "cache").write_text("a file")
    source = tmp_path / "seven.cc"
    source.write_text('extern "C" int seven() { return 7; }\n')
    assert seven(compilers._library(source, None)) == 7
