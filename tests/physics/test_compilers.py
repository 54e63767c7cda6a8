"""Libraries that are built once."""

import os

import pytest

from clothjax.physics import compilers

pytestmark = pytest.mark.skipif(
    None in map(compilers.compiler, compilers.PROGRAMS), reason="needs a C and a C++ compiler"
)


@pytest.fixture
def linked(monkeypatch, tmp_path):
    """What is linked, with a folder for caches of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run, found = compilers.run, []

    def recorded(language, arguments):
        if "-shared" in arguments:
            found.append(language)
        return run(language, arguments)

    monkeypatch.setattr(compilers, "run", recorded)
    return found


@pytest.fixture
def source(tmp_path):
    (tmp_path / "seven.h").write_text("int half(int x);\n#define SEVEN 7\n")
    (tmp_path / "seven.cc").write_text('extern "C" {\n#include "seven.h"\nint seven() { return SEVEN + half(0); }\n}\n')
    (tmp_path / "half.c").write_text("int half(int x) { return x / 2; }\n")
    return tmp_path / "seven.cc"


def seven(source):
    return compilers._load(source, source.with_name("half.c")).seven()


def kept(source):
    return sorted((source.parent / "cache" / "clothjax").iterdir())


def test_a_library_is_built_again_where_it_would_be_another(linked, source, monkeypatch):
    assert seven(source) == seven(source) == 7 and len(linked) == len(kept(source)) == 1
    header, plain = source.with_name("seven.h"), source.with_name("half.c")
    header.write_text(header.read_text().replace("7", "8"))
    assert seven(source) == 8 and len(linked) == 2
    plain.write_text(plain.read_text().replace("x / 2", "x + 1"))
    assert seven(source) == 9 and len(linked) == 3
    monkeypatch.setattr(compilers, "FLAGS", ("-O1",))
    assert seven(source) == 9 and len(linked) == len(kept(source)) == 4
    source.write_text("not C++")
    with pytest.raises(OSError, match=r"failed: (.|\n)*seven\.cc"):
        seven(source)
    assert len(kept(source)) == 4


def test_a_library_that_others_could_have_written_or_that_is_damaged_is_built_again(linked, source):
    assert seven(source) == 7
    (library,) = kept(source)
    for path in (library, library.parent):
        path.chmod(0o777)
        assert seven(source) == 7
        path.chmod(0o700)
    assert len(linked) == 3
    library.write_bytes(b"")
    assert seven(source) == 7 and len(linked) == 4 and library.stat().st_size > 0
    assert seven(source) == 7 and len(linked) == 4


@pytest.mark.parametrize("place", ["a file", "", "relative"])
def test_a_library_that_cannot_be_kept_is_built_in_each_process(linked, source, monkeypatch, capsys, place):
    (source.parent / "a file").write_text("")
    monkeypatch.chdir(source.parent)
    monkeypatch.setenv("XDG_CACHE_HOME", str(source.parent / place) if place == "a file" else place)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # of a user without a home
    before = set(source.parent.iterdir())
    assert seven(source) == seven(source) == 7 and len(linked) == 2
    assert set(source.parent.iterdir()) == before
    assert capsys.readouterr().out.count("not kept, and so built in each process") == (2 if place == "a file" else 0)
