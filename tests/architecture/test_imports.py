import subprocess
import sys

HEAVY = ("can", "canopen", "pymodbus", "numpy", "asyncio")


def test_interface_imports_no_bus_library_and_no_numpy():
    script = (
        "import sys\nfrom motorhil import motorapi\n"
        "motorapi.WallRuntime().close()\n"
        "for name in motorapi.__all__: getattr(motorapi, name)\n"
        f"print([name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
