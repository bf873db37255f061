#!/usr/bin/env python3
"""Runs the SocketCAN tests of tests/guest on a kernel that has CAN.

Usage: .ci/guest.py [--fetch | --host | --keep]

Where this machine's kernel has vcan and we are root, the tests run on it directly (--host insists on that). Elsewhere
Debian's own kernel boots in QEMU with the programs in its initial file system. Its package is fetched once into
<target folder>/kernel (--fetch does only that, and a missing one is then no failure). --keep leaves the guest's files.
The Python packages of `.ci/python.sh` are seen from the guest through a read-only share.

The guest has passed only where QEMU ends with status 33 and the console's last line is the closing line; a kernel that
panics or powers off ends with 0. Exit 0 passed, 1 failed, 4 not run, with the reason in one line.
"""

import gzip
import lzma
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).resolve()
CACHE = TARGET / "kernel"
TESTS = ROOT / "tests" / "guest"
PLANT = ROOT / "tests" / "python" / "plant.py"
# In the order in which they can be loaded: CAN, then what it takes to see folders of this machine (9p over virtio).
CAN_MODULES = ["can-dev", "can", "can-raw", "vcan"]
SHARE_MODULES = ["virtio_ring", "virtio", "virtio_pci_modern_dev", "virtio_pci_legacy_dev", "virtio_pci"]
SHARE_MODULES += ["netfs", "fscache", "9pnet", "9pnet_virtio", "9p"]
MODULES = CAN_MODULES + SHARE_MODULES
POLICIES = ["inverted-pendulum-v5", "hopper-v5", "moving"]
CLOSING = "guest: all passed"
PASSED = 33
LIMIT_S = 600
# A line of ldd.
LIBRARY = r"(?:^\s*|=> )(/.+?) \(0x"
XZ = b"\xfd7zXZ\x00"


class NotRun(Exception):
    """Something is lacking on this machine."""


def output(*command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=True, **options).stdout


# --- the kernel -------------------------------------------------------------------------------------------------------


def cached():
    """The folder with the decompressed kernel and its modules, or None. The stamp lists them and is written last."""
    stamps = sorted(CACHE.glob("6.*/complete")) if CACHE.exists() else []
    found = [stamp.parent for stamp in stamps if stamp.read_text().split() == MODULES]
    return found[-1] if found else None


def package():
    """Name of the current kernel package of Debian."""
    try:
        for line in output("apt-cache", "depends", "linux-image-amd64").splitlines():
            if found := re.match(r"\s*Depends: (linux-image-\d\S*-amd64)", line):
                return found[1]
        names = output("apt-cache", "search", "--names-only", r"^linux-image-[0-9.-]+-amd64(-unsigned)?$").split("\n")
    except (OSError, subprocess.CalledProcessError) as error:
        raise NotRun(f"no kernel package: apt-cache failed ({error}); this needs Debian or a kernel with vcan") from None
    names = sorted((line.split()[0] for line in names if line), key=lambda n: [int(x) for x in re.findall(r"\d+", n)])
    if not names:
        raise NotRun("apt knows no kernel package linux-image-*-amd64; run `apt-get update` on Debian 12")
    return names[-1]


def fetch():
    """Fetches the kernel package, unless it is there, and returns its folder."""
    if folder := cached():
        return folder
    if os.uname().machine != "x86_64":
        raise NotRun("the guest is for x86_64 machines")
    name = package()
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as scratch:
        print(f"guest: fetching {name} (about 70 MB)", file=sys.stderr, flush=True)
        got = subprocess.run(["apt-get", "download", "-q", name], cwd=scratch, capture_output=True, text=True)
        debs = list(Path(scratch).glob("*.deb"))
        if got.returncode != 0 or not debs:
            reason = next((line for line in got.stderr.splitlines() if line.startswith("E:")), "no message")
            raise NotRun(f"apt-get could not download {name} ({reason}); check the network and `apt-get update`")
        subprocess.run(["dpkg-deb", "-x", debs[0].name, "x"], cwd=scratch, check=True)
        tree = Path(scratch) / "x"
        image = next(tree.glob("boot/vmlinuz-*"))
        folder = CACHE / image.name.removeprefix("vmlinuz-")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        # The image holds one XZ stream, an ELF file that QEMU starts directly: that halves the boot.
        data = image.read_bytes()
        kernel = lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(data[data.index(XZ):])
        (folder / "vmlinux").write_bytes(kernel)
        for module in MODULES:
            shutil.copy(next(tree.glob(f"**/{module}.ko")), folder)
        (folder / "complete").write_text("\n".join(MODULES))
    return folder


# --- the guest --------------------------------------------------------------------------------------------------------


class Archive:
    """A file system in the form of `cpio -H newc`."""

    def __init__(self):
        self.entries, self.names = [], set()

    def add(self, name, mode, data=b"", device=(0, 0)):
        name = name.strip("/")
        if name in self.names:
            return
        parent = os.path.dirname(name)
        if parent:
            self.add(parent, 0o040755)
        self.names.add(name)
        self.entries.append(self.entry(name, mode, data, device))

    def entry(self, name, mode, data, device=(0, 0)):
        path = name.encode() + b"\0"
        fields = [len(self.entries) + 1, mode, 0, 0, 1, 0, len(data), 0, 0, *device, len(path), 0]
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + path
        return head + b"\0" * (-len(head) % 4) + data + b"\0" * (-len(data) % 4)

    def file(self, source, name=None):
        self.add(name or str(source), 0o100755, Path(source).read_bytes())

    def program(self, source, name=None):
        """A program with every library that the loader would take, in the same places and where it looks by itself."""
        self.file(source, name)
        listed = subprocess.run(["ldd", source], capture_output=True, text=True).stdout
        if "not found" in listed:
            raise NotRun(f"{source} lacks libraries: {listed}")
        # A path may hold spaces.
        for path in re.findall(LIBRARY, listed, re.MULTILINE):
            self.file(path)
            # A path relative to the program means another folder here.
            self.file(path, f"lib/{os.uname().machine}-linux-gnu/{os.path.basename(path)}")

    def write(self, path):
        data = b"".join(self.entries) + self.entry("TRAILER!!!", 0, b"")
        with gzip.open(path, "wb", compresslevel=1) as out:
            out.write(data)


def tool(name, where):
    found = shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
    if not found:
        raise NotRun(f"{name} not found; install it (Debian: apt-get install {where})")
    return os.path.realpath(found)


def build():
    """Builds the program under test, as the other tests do, and returns its path."""
    subprocess.run(["cargo", "build", "--quiet", "--locked", "-p", "gadm-sim"], cwd=ROOT, check=True)
    return TARGET / "debug" / "gadm-sim"


PYTHON = (ROOT / "target" / "python").resolve()
# What the Python tests of the guest import, and all that this loads.
PROBE = """
import can.interfaces.socketcan, cantools, crccheck.crc, gymnasium, mujoco, numpy, sysconfig
gymnasium.make("Hopper-v5")
print(sysconfig.get_path("stdlib"))
with open("/proc/self/maps", encoding="utf-8") as maps:
    print(*sorted({line.split(None, 5)[5].strip() for line in maps if ".so" in line}), sep="\\n")
"""
# Nothing is drawn, and there is no display.
PYTHON_ENV = {"MUJOCO_GL": "disable", "PYTHONDONTWRITEBYTECODE": "1"}


def python():
    """The interpreter with the packages of the tests, the folders that it reads, and libraries that lie elsewhere."""
    got = subprocess.run([ROOT / ".ci" / "python.sh"], capture_output=True, text=True)
    if got.returncode != 0:
        raise NotRun((got.stderr.strip().splitlines() or ["no message"])[-1])
    program = PYTHON / "bin" / "python"
    stdlib, *libraries = output(program, "-c", PROBE, env={**os.environ, **PYTHON_ENV}).splitlines()
    folders = [PYTHON, Path(stdlib)]
    # Under the names that the loader looks for. One may have been loaded by its path, for which this finds nothing.
    needed = sorted(set(re.findall(LIBRARY, output("ldd", *libraries), re.MULTILINE)))
    return program, folders, [lib for lib in needed if not any(Path(lib).is_relative_to(f) for f in folders)]


def sharing(qemu):
    """Raises where this QEMU cannot share folders."""
    if "virtio-9p-pci" not in output(qemu, "-device", "help"):
        raise NotRun(f"{qemu} cannot share folders (no virtio-9p-pci)")


INIT = """#!/bin/sh
mount -t proc proc /proc; mount -t sysfs sysfs /sys; mount -t devtmpfs devtmpfs /dev; mount -t tmpfs tmpfs /tmp
for module in $modules; do insmod /modules/$module.ko || echo "FAILED: insmod $module"; done
share() {
    mkdir -p "$2"
    mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=524288 "$1" "$2" || echo "FAILED: mount $1 on $2"
}
@shares@
ip link set up lo
if /tests/run.sh /out; then
    byte='\\020'
    echo "$closing"
else
    byte='\\021'
fi
# What the tests left goes to the host over the second serial line.
stty -F /dev/ttyS1 raw
(cd /out && tar cf - .) >/dev/ttyS1
sleep 1
printf "$byte" | dd of=/dev/port bs=1 seek=244 count=1 2>/dev/null
sleep 60
"""


def init(modules, shares, env):
    """The first program of the guest. `shares` are mount tags with their folders."""
    given = {"modules": " ".join(modules), "closing": CLOSING}
    lines = [f"{name}={shlex.quote(str(value))}" for name, value in given.items()]
    lines += [f"export {name}={shlex.quote(str(value))}" for name, value in env.items()]
    mounts = "\n".join(f"share {tag} {shlex.quote(str(folder))}" for tag, folder in shares.items())
    return INIT.replace("@shares@", mounts).replace("\n", "\n" + "\n".join(lines) + "\n", 1)


APPLETS = "sh mount insmod dd sleep printf echo cat grep sed awk cut sort cmp kill tar stty mkdir rm wc head tail timeout cp test true seq tr env"


def in_guest(program, kernel, scratch):
    qemu = tool("qemu-system-x86_64", "qemu-system-x86")
    archive = Archive()
    archive.program(tool("busybox", "busybox-static"), "bin/busybox")
    for applet in APPLETS.split():
        archive.add(f"bin/{applet}", 0o120777, b"busybox")
    archive.program(tool("ip", "iproute2"), "sbin/ip")
    for name in ("candump", "canplayer", "cansend"):
        archive.program(tool(name, "can-utils"), f"usr/bin/{name}")
    archive.program(str(program), "usr/bin/gadm-sim")
    modules, shares, env = CAN_MODULES, {}, {}
    try:
        sharing(qemu)
        interpreter, folders, libraries = python()
        shares = {f"share{i}": folder for i, folder in enumerate(folders)}
        modules, env = MODULES, {**PYTHON_ENV, "PYTHON": PYTHON / "bin" / "python"}
        # The environment has links to it.
        while interpreter.is_symlink():
            interpreter = interpreter.parent / os.readlink(interpreter)
            if not any(interpreter.is_relative_to(folder) for folder in folders):
                archive.program(os.path.realpath(interpreter), str(interpreter))
        for path in libraries:
            archive.file(path)
    except NotRun as reason:
        shares, env = {}, {"NO_PYTHON": str(reason)}
    for module in modules:
        archive.file(kernel / f"{module}.ko", f"modules/{module}.ko")
    for script in TESTS.glob("*.sh"):
        archive.file(script, f"tests/{script.name}")
    archive.file(PLANT, "python/plant.py")
    for name in POLICIES:
        archive.file(ROOT / "models" / name / "policy.bin", f"models/{name}/policy.bin")
    for folder in ("proc", "sys", "dev", "tmp", *map(str, shares.values())):
        archive.add(folder, 0o040755)
    archive.add("dev/console", 0o020600, device=(5, 1))
    archive.add("init", 0o100755, init(modules, shares, env).encode())
    archive.write(scratch / "initramfs.gz")

    results = scratch / "results.tar"
    # The clock is the ACPI timer: where the host is busy, the kernel misjudges the speed of the time stamp counter.
    # Request and reply between two processes: a second CPU of the emulator makes that fifty times slower.
    command = [
        qemu, "-M", "q35", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "1", "-m", "1024", "-display", "none",
        "-monitor", "none", "-no-reboot", "-kernel", str(kernel / "vmlinux"), "-initrd", str(scratch / "initramfs.gz"),
        "-append", "console=ttyS0 quiet panic=-1 mitigations=off clocksource=acpi_pm no_timer_check cryptomgr.notests",
        "-serial", "stdio", "-serial", f"file:{results}", "-device", "isa-debug-exit,iobase=0xf4,iosize=0x01",
    ]  # fmt: skip
    for tag, folder in shares.items():
        # A comma in a value is doubled.
        path = str(folder).replace(",", ",,")
        command += ["-virtfs", f"local,path={path},mount_tag={tag},security_model=none,readonly=on"]
    log, closed = [], False
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    timer = threading.Timer(LIMIT_S, process.kill)
    timer.start()
    try:
        for raw in process.stdout:
            line = raw.decode(errors="replace").rstrip()
            log.append(line)
            closed = closed or line == CLOSING
            print(line, flush=True)
        status = process.wait()
    finally:
        timer.cancel()
        process.kill()
    print(f"guest: kernel {kernel.name}, QEMU's exit status {status}, closing line {'seen' if closed else 'NOT seen'}")
    if status != PASSED or not closed:
        print("FAILED: guest (passed means exit status 33 and the closing line)")
        return None
    out = scratch / "results"
    out.mkdir()
    subprocess.run(["tar", "xf", str(results), "-C", str(out)], check=True)
    return out


def on_host(program, scratch):
    """Runs the same tests on this machine's kernel."""
    out = scratch / "results"
    env = {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}", "MODELS": str(ROOT / "models")}
    try:
        env |= {**PYTHON_ENV, "PYTHON": str(python()[0]), "PLANT": str(PLANT)}
    except NotRun as reason:
        env["NO_PYTHON"] = str(reason)
    done = subprocess.run([str(TESTS / "run.sh"), str(out)], env=env)
    return out if done.returncode == 0 else None


def host_has_vcan():
    ip = shutil.which("ip", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
    if os.geteuid() != 0 or not ip:
        return False
    if modprobe := shutil.which("modprobe", path="/usr/sbin:/sbin"):
        subprocess.run([modprobe, "-q", "-a", "vcan", "can-raw"], capture_output=True)
    made = subprocess.run([ip, "link", "add", "dev", "gadmtest", "type", "vcan"], capture_output=True)
    subprocess.run([ip, "link", "delete", "gadmtest"], capture_output=True)
    return made.returncode == 0


def compare(program, out):
    """The traces that came from SocketCAN against runs in process on this machine, byte for byte."""
    failed = 0
    for trace in sorted(out.glob("*.log")):
        name, profile, episodes, seed = trace.stem.split("_")
        here = out / f"{trace.stem}.here"
        subprocess.run(
            [program, "run", ROOT / "models" / name / "policy.bin", "--profile", profile, "--episodes", episodes]
            + ["--seed", seed, "--trace", here, "--quiet"],
            check=True,
        )
        same = here.read_bytes() == trace.read_bytes()
        lines = trace.read_bytes().count(b"\n")
        print(f"{'ok' if same else 'FAILED'}: trace {trace.stem} from SocketCAN = in process here ({lines} frames)")
        failed += not same
    if not list(out.glob("*.log")):
        print("FAILED: no trace came from the tests")
        failed += 1
    return failed


def main(words):
    if words not in ([], ["--fetch"], ["--host"], ["--keep"]):
        print(__doc__, file=sys.stderr)
        return 2
    try:
        if words == ["--fetch"]:
            fetch()
            return 0
        host = host_has_vcan()
        if words == ["--host"] and not host:
            raise NotRun("this kernel has no vcan, or we are not root")
        kernel = None if host else fetch()
        if not host:
            tool("qemu-system-x86_64", "qemu-system-x86")
        tool("candump", "can-utils")
        program = build()
        scratch = Path(tempfile.mkdtemp(prefix="guest-", dir=TARGET))
        try:
            out = on_host(program, scratch) if host else in_guest(program, kernel, scratch)
            return 1 if out is None or compare(program, out) else 0
        finally:
            if words == ["--keep"]:
                print(f"guest: files in {scratch}")
            else:
                shutil.rmtree(scratch, ignore_errors=True)
    except NotRun as reason:
        print(f"not run: SocketCAN rung: {reason}", flush=True)
        return 4


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
