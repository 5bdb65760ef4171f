import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from scenecaptum import backend
from scenecaptum.backend import _diagnosis, _llvm
from scenecaptum.backend._llvm import LLVMLibrary

SOURCE = Path(backend.__file__).parents[1]


@pytest.fixture(autouse=True)
def _no_explicit_library(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)


@pytest.fixture
def library(tmp_path):
    """Write a file that looks like an LLVM library."""

    def write(content, name="libLLVM.so"):
        path = tmp_path / name
        path.write_bytes(b"\x00" * 100 + content + b"\x00" * 100)
        return path

    return write


@pytest.fixture
def no_trials(monkeypatch):
    def refuse(variant, library=None):
        raise AssertionError(f"a trial of {library} was not needed")

    monkeypatch.setattr(_llvm, "trial_failure", refuse)


def run(code, **environment):
    """Run code in another Python that imports the backend without the rest of the package."""
    preamble = f"""
        import json, os, sys, types
        from pathlib import Path
        package = sys.modules["scenecaptum"] = types.ModuleType("scenecaptum")
        package.__path__ = [{str(SOURCE)!r}]
        from scenecaptum import backend
        from scenecaptum.backend import _llvm
        from scenecaptum.backend import activate
        from scenecaptum.errors import BackendError
    """
    return python("-c", textwrap.dedent(preamble) + textwrap.dedent(code), **environment)


def python(*arguments, **environment):
    """Run another Python."""
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def answer(code, **environment):
    """Return what the code printed as JSON; a process that aborts has no answer."""
    result = run(code, **environment)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def default_library():
    """Return the library chosen without DRJIT_LIBLLVM_PATH, as in most of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
        return _llvm.choose_llvm()


needs_llvm = pytest.mark.skipif(default_library() is None, reason="no usable LLVM found")


# ----------------------------------------------------------------------------------------- reading versions


@pytest.mark.parametrize(
    ("content", "version"),
    [
        (b"libLLVM-14.so.1", 14),
        (b"libLLVM.so.19.1", 19),
        (b"libLLVM.19.1.dylib", 19),
        (b"@rpath/libLLVM.dylib\x00 LLVM version 22.1.0git", 22),
        (b"nothing of the kind", None),
    ],
)
def test_a_version_is_read_from_the_file(library, content, version):
    assert _llvm._read_version(library(content)) == version


def test_real_libraries_state_the_version_in_their_name():
    named = [one for one in _llvm.llvm_libraries() if one.path.name.startswith(("libLLVM-", "libLLVM.so."))]
    if not named:
        pytest.skip("no LLVM library on this machine names its version")
    for one in named:
        assert one.version == int(
            one.path.name.removeprefix("libLLVM-").removeprefix("libLLVM.so.").split(".")[0]
        )


def test_reading_a_version_loads_nothing():
    loaded = answer("""
        _llvm.llvm_libraries()
        maps = Path("/proc/self/maps")
        print(json.dumps("libLLVM" in maps.read_text() if maps.exists() else False))
    """)
    assert not loaded


def test_each_unusable_file_has_a_reason(library, tmp_path):
    assert "too old" in _llvm._inspect(library(b"libLLVM-16.so.1", "old.so")).problem
    assert _llvm._inspect(library(b"", "none.so")).problem == "not an LLVM library"
    assert _llvm._inspect(tmp_path / "absent.so").problem.startswith("unreadable")
    (tmp_path / "empty.so").touch()
    assert _llvm._inspect(tmp_path / "empty.so").problem == "not an LLVM library"
    assert _llvm._inspect(library(b"libLLVM-17.so.1", "new.so")).problem is None


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only ELF files name their processor like this"
)
def test_a_library_for_another_processor_is_skipped(tmp_path):
    header = bytearray(Path(sys.executable).read_bytes()[:64])
    path = tmp_path / "libLLVM.so"
    path.write_bytes(bytes(header) + b"libLLVM.so.19.1")
    assert _llvm._inspect(path).problem is None
    header[18] ^= 1
    path.write_bytes(bytes(header) + b"libLLVM.so.19.1")
    assert _llvm._inspect(path).problem == "built for another processor"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("libLLVM.so", True),
        ("libLLVM-15.so.1", True),
        ("libLLVM.so.19.1", True),
        ("libLLVM.19.1.dylib", True),
        ("libLLVMSupport.a", False),
        ("libLLVM-C.so", False),
        ("libLLVM.so.20.1-rust-1.87.0-stable", False),
    ],
)
def test_only_complete_llvm_libraries_are_considered(tmp_path, name, expected):
    (tmp_path / name).touch()
    assert bool(_llvm._libraries_in(tmp_path)) is expected


def test_links_to_one_library_count_once(library, monkeypatch, tmp_path):
    real, link = library(b"libLLVM.so.19.1"), tmp_path / "libLLVM-19.so"
    link.symlink_to(real)
    monkeypatch.setattr(_llvm, "_library_files", lambda: [link, real, link])
    assert _llvm.llvm_libraries() == [LLVMLibrary(Path(os.path.realpath(real)), 19)]


def test_folders_of_conda_and_the_environment_are_searched(tmp_path, monkeypatch):
    conda, prefix = tmp_path / "conda", tmp_path / "prefix"
    unpacked = prefix / "lib" / "llvm" / "usr" / "lib" / "x86_64-linux-gnu"
    for folder in (conda / "lib", unpacked):
        folder.mkdir(parents=True)
        (folder / "libLLVM.so.19.1").write_bytes(b"libLLVM.so.19.1")
    monkeypatch.setenv("CONDA_PREFIX", str(conda))
    monkeypatch.setattr(sys, "prefix", str(prefix))
    found = list(_llvm._library_files())
    assert conda / "lib" / "libLLVM.so.19.1" in found
    assert unpacked / "libLLVM.so.19.1" in found


# ----------------------------------------------------------------------------------------- choosing


def test_the_newest_tested_version_is_chosen(no_trials):
    libraries = [LLVMLibrary(Path(f"/{version}"), version) for version in (17, 19, 22, 21, 30)]
    assert _llvm.choose_llvm(libraries).version == 22


def test_untested_versions_are_tried_newest_first(monkeypatch):
    monkeypatch.setattr(_llvm, "trial_failure", lambda _, one: "aborts" if one.version == 30 else None)
    libraries = [LLVMLibrary(Path(f"/{version}"), version) for version in (17, 18, 30)]
    assert _llvm.choose_llvm(libraries).version == 18


def test_an_explicit_usable_library_wins(monkeypatch, no_trials):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/19")
    libraries = [LLVMLibrary(Path(f"/{version}"), version) for version in (22, 19)]
    assert _llvm.choose_llvm(libraries).version == 19


@pytest.mark.parametrize("content", [b"libLLVM-15.so.1", b"not a library"])
def test_an_explicit_unusable_library_is_skipped(library, monkeypatch, no_trials, content):
    bad, good = library(content, "bad.so"), library(b"libLLVM.so.19.1")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(bad))
    monkeypatch.setattr(_llvm, "_linker_cache", lambda: [good])
    monkeypatch.setattr(_llvm, "_library_folders", lambda: [])
    assert [one.version for one in _llvm.llvm_libraries()][1] == 19
    assert _llvm.choose_llvm().path == Path(os.path.realpath(good))


def test_a_failed_trial_is_reported_without_aborting(library):
    impostor = LLVMLibrary(library(b"libLLVM.so.99.1"), 99)
    assert "LLVM" in _llvm.trial_failure("llvm_ad_rgb", impostor)


@pytest.mark.skipif(
    not any((one.version or 99) < _llvm.OLDEST_LLVM for one in _llvm.llvm_libraries()),
    reason="no old LLVM on this machine",
)
def test_old_versions_really_fail():
    """If Dr.Jit works with old versions again, the limit should be removed."""
    old = next(one for one in _llvm.llvm_libraries() if (one.version or 99) < _llvm.OLDEST_LLVM)
    assert _llvm.trial_failure("llvm_ad_rgb", LLVMLibrary(old.path, old.version)) is not None


# ----------------------------------------------------------------------------------------- activating


@needs_llvm
def test_activate_skips_an_old_library_and_renders(library):
    got = answer(
        """
        mi = activate()
        import drjit as dr
        again = activate() is mi and mi.variant()
        print(json.dumps([again, str(backend.device()), str(mi.log_level()), os.environ["DRJIT_LIBLLVM_PATH"],
                          list(dr.minimum(mi.Float(1, 3), 2))]))
        """,
        DRJIT_LIBLLVM_PATH=str(library(b"libLLVM-15.so.1")),
        CUDA_VISIBLE_DEVICES="",
    )
    assert got == ["llvm_ad_rgb", "cpu", "LogLevel.Error", str(_llvm.choose_llvm().path), [1, 2]]


def test_without_a_usable_library_the_error_names_the_fix(library):
    message = answer(
        """
        _llvm._linker_cache, _llvm._library_folders = list, list
        try:
            activate("llvm_ad_rgb")
        except BackendError as error:
            print(json.dumps(str(error)))
        """,
        DRJIT_LIBLLVM_PATH=str(library(b"libLLVM-15.so.1")),
    )
    assert "LLVM 15" in message
    assert "too old" in message
    assert f"Fix: {_diagnosis._fix()}" in message


@pytest.mark.parametrize(
    ("platform", "names", "command"),
    [
        ("linux", {"linuxmint", "ubuntu"}, "sudo apt-get install libllvm20"),
        ("linux", {"fedora"}, "sudo dnf install llvm-libs"),
        ("linux", {"arch"}, "sudo pacman -S llvm-libs"),
        ("darwin", set(), "brew install llvm"),
    ],
)
def test_the_fix_depends_on_the_platform(monkeypatch, platform, names, command):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(_diagnosis, "_os_release", lambda: names)
    monkeypatch.setattr(_diagnosis, "_apt_package", lambda: "libllvm20")
    monkeypatch.setattr(_diagnosis, "_is_root", lambda: False)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    assert _diagnosis._fix() == command
    monkeypatch.setattr(_diagnosis, "_is_root", lambda: True)
    assert _diagnosis._fix() == command.removeprefix("sudo ")
    monkeypatch.setenv("CONDA_PREFIX", "/conda")
    assert _diagnosis._fix() == "conda install -c conda-forge libllvm19"


@pytest.mark.parametrize(
    ("listed", "package"),
    [
        (["libllvm22", "libllvm19", "libllvm18"], "libllvm19"),
        (["libllvm17", "libllvm18", "libllvm20", "libllvm22"], "libllvm20"),
        (["libllvm17", "libllvm18"], "libllvm18"),
        ([], None),
    ],
)
def test_apt_is_asked_which_packages_it_knows(monkeypatch, tmp_path, listed, package):
    stanzas = "".join(f"Package: {name}\nDepends: libllvm19\n\n" for name in listed)
    asked = '[ "$1" = show ] && [ "$2" = libllvm19 ]'
    apt_cache = tmp_path / "apt-cache"
    apt_cache.write_text(
        f"#!/bin/sh\n{asked} && printf '%s' '{stanzas}'\necho 'E: No packages found' >&2\nexit 100\n"
    )
    apt_cache.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert _diagnosis._apt_package() == package


def test_without_an_apt_package_another_source_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))  # no apt-cache: the same as one without packages
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(_diagnosis, "_os_release", lambda: {"ubuntu", "debian"})
    monkeypatch.setattr(_diagnosis, "_is_root", lambda: False)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    fix = _diagnosis._fix()
    assert fix.startswith(
        "sudo apt-get update && sudo apt-get install libllvm19. If apt knows no such package: "
    )
    assert "conda install" in fix
    assert "DRJIT_LIBLLVM_PATH" in fix


def test_an_unknown_system_still_gets_advice(monkeypatch):
    monkeypatch.setattr(_diagnosis, "_os_release", set)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    assert "DRJIT_LIBLLVM_PATH" in _diagnosis._fix()


@needs_llvm
def test_variants_are_switched_kept_or_refused():
    got = answer("""
        def attempt(*arguments):
            try:
                return activate(*arguments).variant()
            except BackendError as error:
                return str(error)

        unknown = attempt("llvm_ad_rbg")
        spectral = attempt("llvm_ad_spectral")
        kept = attempt()
        scalar = attempt("scalar_rgb")
        import mitsuba as mi
        mi.set_variant("scalar_rgb")
        users_scalar = attempt()
        switched = attempt("llvm_ad_rgb")
        print(json.dumps([unknown, spectral, kept, scalar, users_scalar, switched]))
    """)
    unknown, spectral, kept, scalar, users_scalar, switched = got
    assert "'llvm_ad_rbg'" in unknown
    assert "Did you mean 'llvm_ad_rgb'" in unknown
    assert (spectral, kept, switched) == ("llvm_ad_spectral", "llvm_ad_spectral", "llvm_ad_rgb")
    assert "cannot be differentiated" in scalar
    assert "mi.set_variant('scalar_rgb'): remove" in users_scalar
    assert "scenecaptum.activate(" in users_scalar


def test_cuda_without_a_device_is_refused_with_the_alternative():
    message = answer(
        """
        try:
            activate("cuda_ad_rgb")
        except BackendError as error:
            print(json.dumps(str(error)))
        """,
        CUDA_VISIBLE_DEVICES="",
    )
    assert "needs CUDA" in message
    assert "activate('llvm_ad_rgb')" in message


def test_a_driver_alone_does_not_make_cuda_the_default(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setattr(os.path, "exists", lambda _: True)
    _llvm.trial_failure.cache_clear()
    assert _diagnosis._cuda_problem() is not None
    assert backend.default_variant() == "llvm_ad_rgb"
    _llvm.trial_failure.cache_clear()


@needs_llvm
def test_dr_jit_imported_before_llvm_was_found_is_explained():
    message = answer(
        """
        import drjit
        try:
            activate("llvm_ad_rgb")
        except BackendError as error:
            print(json.dumps(str(error)))
        """,
        DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so",
    )
    assert "before importing mitsuba or drjit" in message
    assert f"DRJIT_LIBLLVM_PATH={_llvm.choose_llvm().path}" in message


def test_importing_the_backend_imports_nothing_heavy():
    heavy = answer("""
        names = ("torch", "mitsuba", "drjit", "numpy", "matplotlib")
        print(json.dumps([name for name in names if name in sys.modules]))
    """)
    assert heavy == []


# ----------------------------------------------------------------------------------------- diagnosing


@needs_llvm
def test_the_diagnosis_of_a_working_machine(monkeypatch):
    monkeypatch.setattr(_diagnosis, "_import_failure", lambda _: None)  # of what is optional
    diagnosis = backend.diagnose()
    text = str(diagnosis)
    assert diagnosis.ok, text
    assert diagnosis.fix is None
    assert text.endswith("All is well: scenes can be rendered and differentiated.")
    assert f"chosen: {_llvm.choose_llvm().path}" in text
    names = [name for name, _ in diagnosis.rows]
    assert {"Python", "torch", "Mitsuba", "Dr.Jit", "CUDA", "Variant", "Renderer", "Cores"} <= set(names)
    columns = {
        line.index(finding) for line, (_, finding) in zip(text.splitlines(), diagnosis.rows, strict=False)
    }
    assert len(columns) == 1, "findings should stand in one column"


def test_the_diagnosis_without_llvm_names_the_fix(library, monkeypatch, capsys):
    old = library(b"libLLVM-15.so.1")
    monkeypatch.setattr(_llvm, "_library_files", lambda: [old])
    monkeypatch.setattr(_diagnosis, "_cuda_problem", lambda: "no NVIDIA driver")
    assert backend.main() == 1
    text = capsys.readouterr().out
    assert "LLVM 15" in text
    assert "too old" in text
    assert text.rstrip().endswith(f"Fix: {_diagnosis._fix()}")


def test_an_optional_package_that_is_missing_is_not_a_problem(monkeypatch):
    monkeypatch.setattr(_diagnosis, "_installed", lambda _: None)
    assert _diagnosis._import_failure("torchvision") is None
    assert _diagnosis._optional("torchvision", None) == ("not installed (optional, for torchvision's models)")


@needs_llvm
@pytest.mark.parametrize(
    ("torch", "remedy"),
    [
        (
            "2.13.0+cpu",
            "install torchvision and torch 2.13.0+cpu from the same index: pytorch.org/get-started shows the "
            "command for cpu. Before it: PYTHON -m pip uninstall -y torchvision",
        ),
        (
            "2.13.0",
            "PYTHON -m pip uninstall -y torchvision && PYTHON -m pip install torch==2.13.0 torchvision",
        ),
    ],
)
def test_a_torchvision_for_another_torch_is_not_well(monkeypatch, tmp_path, capsys, torch, remedy):
    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    monkeypatch.setattr(_diagnosis, "_installed", lambda package: torch if package == "torch" else "0.28.0")
    assert backend.main() == 0, "scenes can still be rendered"
    *table, verdict, fix = capsys.readouterr().out.splitlines()
    (row,) = [line for line in table if line.startswith("torchvision")]
    assert row.endswith("0.28.0, cannot be imported: operator torchvision::nms does not exist")
    assert verdict == ("Scenes can be rendered and differentiated. What does not work: torchvision's models.")
    # What is not a command has nothing to fill in: a placeholder or parentheses would break a shell.
    assert fix == f"Fix: {remedy.replace('PYTHON', Path(sys.executable).name)}"


def test_another_package_that_cannot_be_imported_is_installed_again():
    assert _diagnosis._reinstallation("captum", "2.13.0").endswith(
        "pip install --force-reinstall --no-deps captum"
    )


def test_the_backend_can_be_run_as_the_doctor():
    result = python("-m", "scenecaptum.backend")
    assert result.returncode == 0, result.stderr
    assert "can be rendered and differentiated" in result.stdout


def test_the_doctor_runs_without_llvm():
    code = """
        import sys
        from scenecaptum import cli
        from scenecaptum.backend import _diagnosis, _llvm
        _llvm._linker_cache, _llvm._library_folders = list, list
        _diagnosis._import_failure = lambda _: None  # of what is optional: another test imports it
        status = cli.main(["doctor"])
        assert not {"mitsuba", "drjit"} & set(sys.modules), "it imported what cannot work"
        sys.exit(status)
    """
    result = python("-c", textwrap.dedent(code), CUDA_VISIBLE_DEVICES="")
    assert result.returncode == 1, result.stderr
    assert result.stderr == ""
    *table, verdict, fix = result.stdout.splitlines()
    assert ["LLVM", "none", "found"] in [line.split() for line in table]
    assert verdict == "Rendering will not work."
    assert fix == f"Fix: {_diagnosis._fix()}"


def test_the_diagnosis_names_a_missing_package(monkeypatch):
    monkeypatch.setattr(_diagnosis, "_installed", lambda package: None if package == "drjit" else "1.0")
    diagnosis = backend.diagnose()
    assert not diagnosis.ok
    assert diagnosis.fix.endswith("-m pip install drjit")


def test_a_failing_trial_render_is_a_failed_diagnosis(library, monkeypatch):
    good = library(b"libLLVM.so.19.1")  # by its bytes; the trial finds out
    monkeypatch.setattr(_llvm, "_library_files", lambda: [good])
    monkeypatch.setattr(_diagnosis, "_cuda_problem", lambda: "no NVIDIA driver")
    diagnosis = backend.diagnose()
    assert not diagnosis.ok
    assert "Rendering will not work." in str(diagnosis)
