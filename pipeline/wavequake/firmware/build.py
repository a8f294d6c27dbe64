"""Build images of the boards with a compiler of the machine, or with the one in the `ziglang` wheel."""

import os
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.firmware.gains import Gains, header

MARK = b"wavequake-gains:"
COMMON = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-strict-aliasing")
CORTEX = (
    "-ffreestanding",
    "-ffunction-sections",
    "-fno-builtin",
    "-fno-unwind-tables",
    "-fno-asynchronous-unwind-tables",
    "-Wl,--gc-sections",
    "-Wl,-e,wq_reset_handler",
)


@dataclass(frozen=True)
class Board:
    """How the image of a board is built, and how it is flashed.

    Attributes
    ----------
    name, suffix : str
    clock_hz : float
        Zero where the board is no hardware.
    gcc, zig : tuple of str
        Commands, the flags of the target included; empty where there is none.
    package : str
        What brings a compiler.
    flash : str
        Command lines, with {image} for the file's name without suffix and {objcopy} for what makes a
        binary of an ARM's image.
    tools : str
        What brings the tools of `flash`.
    """

    name: str
    suffix: str
    clock_hz: float
    gcc: tuple[str, ...]
    zig: tuple[str, ...]
    package: str
    flash: str = ""
    tools: str = ""


_ZIG_ARM = ("-target", "thumb-freestanding-eabi", "-mcpu=cortex_m3", *CORTEX, "-fno-sanitize=undefined")
_GCC_ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m3", "-mthumb", "-nostdlib", *CORTEX)
_ARM = "ziglang from PyPI (extra firmware) or Debian's gcc-arm-none-eabi"
_GCC_AVR = (
    "avr-gcc", "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-ffunction-sections",
    "-Wl,--gc-sections", "-Wl,-u,wq_hash",
)  # fmt: skip
_AVR = "Debian's gcc-avr and avr-libc"
BOARDS = {
    "host": Board(
        "host", ".so", 0.0, ("cc", "-shared", "-fPIC"), ("-shared", "-fPIC"),
        "a C compiler, or ziglang from PyPI (extra firmware)",
    ),
    "due": Board(
        "due", ".elf", 84e6, _GCC_ARM, _ZIG_ARM, _ARM,
        "{objcopy} -O binary {image}.elf {image}.bin\n"
        "bossac -a -p ttyACM0 -e -w -v -b {image}.bin -R",
        "bossac comes with Debian's bossa-cli; the cable goes to the programming port, here ttyACM0.",
    ),
    "qemu": Board("qemu", ".elf", 0.0, _GCC_ARM, _ZIG_ARM, _ARM),
    "simavr": Board("simavr", ".elf", 16e6, _GCC_AVR, (), _AVR),
    "uno": Board(
        "uno", ".elf", 16e6, _GCC_AVR, (), _AVR,
        "avr-objcopy -O ihex {image}.elf {image}.hex\n"
        "avrdude -p m328p -c arduino -P /dev/ttyACM0 -b 115200 -U flash:w:{image}.hex:i",
        "avr-objcopy and avrdude come with Debian's binutils-avr and avrdude; the port is here ttyACM0.",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Image:
    """A built image.

    Attributes
    ----------
    board : Board
    gains : Gains
    path : Path
    compiler : str
    """

    board: Board
    gains: Gains
    path: Path
    compiler: str


def compiler_of(board: Board, prefer: str = "") -> tuple[str, ...]:
    """Return the command that compiles for a board; `prefer` is "gcc", "zig" or nothing.

    Raises
    ------
    UserError
        If there is none; names the package that brings it.
    """
    zig = (sys.executable, "-m", "ziglang", "cc", *board.zig)
    if prefer != "zig" and shutil.which(board.gcc[0]):
        return board.gcc
    if prefer != "gcc" and board.zig and find_spec("ziglang"):
        return zig
    raise UserError(f"No compiler for the board {board.name!r} is installed; it needs {board.package}.")


def build(board: str, gains: Gains, target: Path, *, prefer: str = "", more: tuple[str, ...] = ()) -> Image:
    """Write the header and build an image into a folder.

    Parameters
    ----------
    board : str
        Of `BOARDS`.
    gains : Gains
    target : Path
        Folder; made where it is missing.
    prefer : str
        "gcc", "zig" or nothing.
    more : tuple of str
        Further flags.

    Raises
    ------
    UserError
        If the board is not known, there is no compiler, or it fails (says its words).
    """
    chosen = board_of(board)
    command = compiler_of(chosen, prefer)
    sources = folder("firmware")
    generated = write_header(gains, target)
    place = sources / "boards" / board
    path = target / f"{board}-{gains.variant}{chosen.suffix}"
    scripts = [f"-Wl,-T,{file}" for file in sorted(place.glob("*.ld"))]
    shared = sorted((sources / "boards" / "cortex-m").glob("*.c")) if board in ("due", "qemu") else []
    files = [*sorted((sources / "core").glob("*.c")), *sorted(place.glob("*.c")), *shared]
    words = [
        *(*command, *COMMON, *more, f"-I{generated}", f"-I{sources / 'core'}", *scripts),
        *(*map(str, files), "-o", str(path)),
    ]
    if command[0] == "arm-none-eabi-gcc":
        words.append("-lgcc")
    # A partial image shall not stand for a whole one, and zig's local cache is not for the working folder.
    environment = os.environ | {"ZIG_LOCAL_CACHE_DIR": str(target / ".zig")}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        path.unlink(missing_ok=True)
        lines = done.stderr.strip().splitlines()
        first = next((line for line in lines if "error" in line), lines[0] if lines else "it says nothing")
        raise UserError(f"{shlex.join(command[:4])} failed for the board {board!r}: {first.strip()}")
    return Image(chosen, gains, path, "zig" if "ziglang" in command else command[0])


def write_header(gains: Gains, target: Path) -> Path:
    """Write wq_gains.h into a folder of the arithmetic's name below `target`; return that folder."""
    generated = target / f"gains-{gains.variant}"
    generated.mkdir(parents=True, exist_ok=True)
    path, text = generated / "wq_gains.h", header(gains)
    if not (path.is_file() and path.read_text() == text):  # make builds anew what is older than the header
        path.write_text(text)
    return generated


def board_of(name: str) -> Board:
    """Return a board by its name."""
    if name not in BOARDS:
        raise UserError(f"There is no board {name!r}; there are {', '.join(BOARDS)}.")
    return BOARDS[name]


def flash_lines(board: Board, image: Path) -> str:
    """Return the command lines that flash an image, with the tools that built it."""
    zig = not shutil.which("arm-none-eabi-objcopy") and find_spec("ziglang")
    objcopy = f"{shlex.quote(sys.executable)} -m ziglang objcopy" if zig else "arm-none-eabi-objcopy"
    return board.flash.format(image=image.with_suffix(""), objcopy=objcopy)


def image_hash(path: Path) -> str:
    """Return the hash of the design that an image carries.

    Raises
    ------
    UserError
        If the file is missing or carries none.
    """
    if not path.is_file():
        board, _, variant = path.stem.partition("-")
        raise UserError(
            f"There is no image {path}; `wavequake firmware build --boards {board} --arithmetic {variant}` "
            "makes it."
        )
    data = path.read_bytes()
    at = data.find(MARK)
    found = data[at + len(MARK) : at + len(MARK) + 16]
    if at < 0 or not all(byte in b"0123456789abcdef" for byte in found):
        raise UserError(f"{path} carries no hash of gains; it is no image of Wavequake's firmware.")
    return found.decode()


def check_hash(path: Path, gains: Gains) -> None:
    """Raise UserError if an image was built from other gains."""
    found = image_hash(path)
    if found != gains.digest:
        raise UserError(
            f"{path} was built from gains {found}, but the design has {gains.digest}; build it again."
        )
