import subprocess
import sys

HEAVY = ("can", "canopen", "pymodbus", "numpy", "asyncio")


def loaded_by(script: str) -> str:
    """Return which of the heavy packages a script loads."""
    script = f"import sys\n{script}\nprint([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_interface_imports_no_bus_library_and_no_numpy():
    script = (
        "from motorhil import motorapi\n"
        "motorapi.WallRuntime().close()\n"
        "for name in motorapi.__all__: getattr(motorapi, name)"
    )
    assert loaded_by(script) == "[]"


def test_emulated_rig_imports_no_bus_library():
    assert loaded_by("import motorhil.harness.rig.rig, motorhil.harness.cli.serve") == "[]"
