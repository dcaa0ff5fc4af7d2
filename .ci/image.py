"""Run every step of ``docker/Dockerfile`` in an empty Debian root, then start the server there and stream a surface.

``python .ci/image.py FOLDER`` needs root, debootstrap and network, but no engine of containers. It reads the steps from
the Dockerfile itself; an instruction or option that is not known here is an error. Each stage has a root of its own in
the folder. The server starts as the user of the image, in namespaces of its own for files, processes and network, with
a root that is read-only as in ``docker/compose.yaml``. Where this machine cannot do it, the program fails and says why
in one line.

One thing differs from the image: ``python:X-slim-SUITE`` is Debian's SUITE with a Python compiled into ``/usr/local``.
Here it is the same SUITE with Debian's own Python, as a virtual environment in ``/usr/local``. Both versions are
printed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCKERFILE = ROOT / "docker/Dockerfile"

#: Packages of the official image of Python that a minimal Debian lacks, and Debian's Python in place of the image's.
PACKAGES = "ca-certificates,netbase,tzdata,python3-venv"
PATH = "/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin"
#: Variables by which the steps reach the network of this machine, and its certificates.
NETWORK = re.compile(r"(?i)(https?|no)_proxy|(SSL_CERT|NODE_EXTRA_CA|PIP_(CERT|INDEX|EXTRA_INDEX)|REQUESTS_CA)\w*")
CERTIFICATES = Path("etc/ssl/certs/ca-certificates.crt")

_BASE = re.compile(r"python:(?P<version>\d+\.\d+)-slim-(?P<suite>[a-z]+)(?: AS (?P<name>\w+))?")
_MOUNT = re.compile(r"--mount=type=bind,from=(\w+),source=(/\S+),target=(/\S+)\s+")
_HEALTH = re.compile(r"(?:--(?:interval|timeout|start-period|retries)=\w+\s+)+CMD\s+(?P<command>\[.*\])")

_START_SECONDS = 60

# What the client does in the image: it makes a file, uploads it, streams it, and compares.
_CLIENT = """
import subprocess, sys, numpy
y, x = numpy.mgrid[0:200, 0:300]
heights = (900 + 80 * numpy.sin(x / 9) * numpy.cos(y / 7)).astype("float32")
numpy.save("/tmp/heights.npy", heights)
run = lambda *words: subprocess.run(["lodestream", *words], check=True, text=True, stdout=subprocess.PIPE).stdout
url = run("push", "/tmp/heights.npy", sys.argv[1]).split()[-1]
run("pull", url, "/tmp/back.npy")
assert numpy.array_equal(numpy.load("/tmp/back.npy"), heights)
print(url, "streamed, to the last bit")
"""


@dataclass(frozen=True)
class Instruction:
    """An instruction of a Dockerfile: its name, and what follows on one line."""

    name: str
    text: str


@dataclass
class Stage:
    """A root that instructions change, and what they have set for those after them."""

    root: Path
    folder: str = "/"
    user: str = "root"
    variables: dict[str, str] = field(default_factory=lambda: {"PATH": PATH})
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    health: list[str] = field(default_factory=list)
    volumes: list[str] = field(default_factory=list)
    port: str = ""


def instructions(text: str) -> list[Instruction]:
    """Return the instructions of a Dockerfile, without comments and with continued lines joined."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n", " ", "\n".join(lines))
    return [Instruction(*line.strip().split(maxsplit=1)) for line in joined.splitlines()]


def ignored(path: str, patterns: list[str]) -> bool:
    """Return whether patterns of a ``.dockerignore`` leave out a path of the context; the last that fits decides."""
    verdict = False
    for pattern in patterns:
        glob = re.escape(pattern.removeprefix("!")).replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*")
        if re.fullmatch(f"{glob}(/.*)?", path):
            verdict = not pattern.startswith("!")
    return verdict


class Image:
    """The stages of a Dockerfile, each made in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._named: dict[str, Stage] = {}
        self._stage: Stage | None = None
        rules = DOCKERFILE.with_name("Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
        self._rules = [rule.strip() for rule in rules if rule.strip() and not rule.startswith("#")]

    @property
    def stage(self) -> Stage:
        """The stage that instructions change now."""
        if self._stage is None:
            sys.exit("The Dockerfile does not begin with FROM")
        return self._stage

    def follow(self, instruction: Instruction) -> None:
        """Do what an instruction says; one that is not known ends the program."""
        say(f"{instruction.name} {instruction.text}")
        known: dict[str, Callable[[str], object]] = {
            "FROM": self._from,
            "WORKDIR": self._workdir,
            "COPY": self._copy,
            "RUN": self._run,
            "USER": self._user,
            "ENV": self._env,
            "VOLUME": lambda text: self.stage.volumes.append(text),
            "EXPOSE": lambda text: setattr(self.stage, "port", text),
            "HEALTHCHECK": lambda text: setattr(self.stage, "health", words(match(_HEALTH, text)["command"])),
            "ENTRYPOINT": lambda text: setattr(self.stage, "entrypoint", words(text)),
            "CMD": lambda text: setattr(self.stage, "command", words(text)),
        }
        if instruction.name not in known:
            sys.exit(f"{instruction.name} is not known to {Path(__file__).name}")
        known[instruction.name](instruction.text)

    def _from(self, text: str) -> None:
        found = match(_BASE, text)
        empty = self._folder / found["suite"]
        if not empty.exists():
            step("debootstrap", "--variant=minbase", f"--include={PACKAGES}", found["suite"], str(empty), quiet=True)
            step("chroot", str(empty), "python3", "-m", "venv", "/usr/local")
        root = self._folder / f"stage-{len(list(self._folder.glob('stage-*')))}"
        step("cp", "--archive", str(empty), str(root))
        # The network of this machine: its resolver and certificates.
        for path in (Path("etc/resolv.conf"), CERTIFICATES):
            shutil.copy("/" / path, root / path)
        self._stage = Stage(root)
        if found["name"]:
            self._named[found["name"]] = self._stage
        own = self.output("python", "-c", "import platform; print(platform.python_version())")
        say(f"   the image has Python {found['version']}; this is Debian's {own}, of {found['suite']}")

    def _workdir(self, text: str) -> None:
        self.stage.folder = os.path.join(self.stage.folder, text)
        self.inside(self.stage.folder).mkdir(parents=True, exist_ok=True)

    def _copy(self, text: str) -> None:
        *sources, target = plain(text).split()
        into = self.inside(os.path.join(self.stage.folder, target))
        for source in sources:
            paths = [ROOT / source] if (ROOT / source).is_file() else sorted((ROOT / source).rglob("*"))
            for path in paths:
                name = path.relative_to(ROOT).as_posix()
                if path.is_dir() or ignored(name, self._rules):
                    continue
                inner = path.relative_to(ROOT / source) if path != ROOT / source else path.name
                (into / inner).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, into / inner)

    def _run(self, text: str) -> None:
        mounts = []
        while found := _MOUNT.match(text):
            stage, source, target = found.groups()
            mounts.append((str(self._named[stage].root) + source, target))
            text = text[found.end() :]
        code = subprocess.run(self.isolated(["sh", "-c", plain(text)], mounts=mounts), check=False).returncode
        if code:
            sys.exit(f"The step ended with {code}")

    def _user(self, text: str) -> None:
        self.stage.user = text
        home = next(line.split(":")[5] for line in self.inside("/etc/passwd").open() if line.startswith(f"{text}:"))
        self.stage.variables["HOME"] = home

    def _env(self, text: str) -> None:
        for word in shlex.split(text):
            name, _, value = word.partition("=")
            self.stage.variables[name] = value

    def inside(self, path: str) -> Path:
        """Return the path on this machine of a path in the root."""
        return self.stage.root / path.lstrip("/")

    def output(self, *command: str) -> str:
        """Run a command in the root and return what it prints, on one line."""
        done = subprocess.run(self.isolated(list(command)), check=True, text=True, stdout=subprocess.PIPE)
        return done.stdout.strip()

    def isolated(self, command: list[str], *, mounts: list[tuple[str, str]] | None = None) -> list[str]:
        """Return the command that runs a step of the build in the root, with the network of this machine."""
        network = {name: value for name, value in os.environ.items() if NETWORK.fullmatch(name)}
        return ["unshare", "--mount", "--pid", "--fork", "--kill-child", *self._script(command, network, mounts or [])]

    def served(self) -> list[str]:
        """Return the command that runs the image as `compose.yaml` does, with a network of its own."""
        command = ["setpriv", "--no-new-privs", *self.stage.entrypoint, *self.stage.command]
        script = self._script(command, {}, [], read_only=True)
        return ["unshare", "--net", "--mount", "--pid", "--fork", "--kill-child", *script]

    def beside(self, process: int, command: list[str]) -> list[str]:
        """Return the command that runs another one in the namespaces of a running image, as its user."""
        inner = shlex.join(self._entered(command, {}))
        return ["nsenter", f"--target={process}", "--net", "--mount", "--pid", "sh", "-c", inner]

    def _script(
        self, command: list[str], more: dict[str, str], mounts: list[tuple[str, str]], *, read_only: bool = False
    ) -> list[str]:
        root = str(self.stage.root)
        lines = [
            ["mount", "--bind", root, root],
            ["mount", "-t", "proc", "proc", f"{root}/proc"],
            ["mount", "-t", "tmpfs", "tmpfs", f"{root}/dev/shm"],
        ]
        for source, target in mounts:
            lines += [["mkdir", "-p", root + target], ["mount", "--bind", "--read-only", source, root + target]]
        if read_only:
            lines += [["mount", "--bind", root + volume, root + volume] for volume in self.stage.volumes]
            lines += [["mount", "-t", "tmpfs", "tmpfs", f"{root}/tmp"], ["mount", "-o", "remount,bind,ro", root]]
            lines += [["ip", "link", "set", "lo", "up"]]
        lines.append(["exec", *self._entered(command, more)])
        return ["sh", "-e", "-c", "\n".join(shlex.join(line) for line in lines)]

    def _entered(self, command: list[str], more: dict[str, str]) -> list[str]:
        variables = [f"{name}={value}" for name, value in (more | self.stage.variables).items()]
        inner = ["env", "--ignore-environment", f"--chdir={self.stage.folder}", *variables, *command]
        return ["chroot", f"--userspec={self.stage.user}", str(self.stage.root), *inner]


def match(pattern: re.Pattern[str], text: str) -> re.Match[str]:
    """Match the text of an instruction; one that says something else ends the program."""
    found = pattern.fullmatch(text.strip())
    if found is None:
        sys.exit(f"not known to {Path(__file__).name}: {text}")
    return found


def plain(text: str) -> str:
    """Return the text of an instruction that has no options, which are not known here."""
    if text.startswith("--"):
        sys.exit(f"not known to {Path(__file__).name}: {text}")
    return text


def words(text: str) -> list[str]:
    """Return the words of a command, which must be in JSON: a shell in between would not pass signals on."""
    command: list[str] = json.loads(text)
    return command


def say(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)


def step(*command: str, quiet: bool = False) -> None:
    """Run a command of this machine, which must succeed."""
    done = subprocess.run(command, check=False, text=True, stdout=subprocess.PIPE if quiet else None)
    if done.returncode:
        sys.exit(f"{done.stdout or ''}{command[0]} ended with {done.returncode}")


@contextmanager
def running(image: Image) -> Iterator[int]:
    """Run the image for the length of a block and end it as ``docker stop`` does; the number of its first process."""
    with subprocess.Popen(image.served()) as outer:
        try:
            children = Path(f"/proc/{outer.pid}/task/{outer.pid}/children")
            until = time.monotonic() + _START_SECONDS
            while not (first := children.read_text().split()):
                if outer.poll() is not None or time.monotonic() > until:
                    sys.exit("The image did not start")
                time.sleep(0.1)
            process = int(first[0])
            yield process
            os.kill(process, 15)
            code = outer.wait(_START_SECONDS)
            say(f"   stopped by SIGTERM, ended with {code}")
            if code:
                sys.exit("The server ended otherwise than by itself")
        finally:
            outer.kill()


def wait_for_health(image: Image, process: int) -> None:
    """Wait until the command of HEALTHCHECK succeeds."""
    until = time.monotonic() + _START_SECONDS
    check = image.beside(process, image.stage.health)
    while subprocess.run(check, capture_output=True, check=False).returncode:
        if time.monotonic() > until:
            sys.exit("HEALTHCHECK does not succeed")
        time.sleep(1)


def try_server(image: Image) -> None:
    """Create a token, start the server, upload a surface and stream it."""
    stage = image.stage
    say("lodestream token create NAME --scope write, as the comment of the Dockerfile says")
    token = image.output(*stage.entrypoint, "token", "create", "check", "--scope", "write").split()[-1]
    say(f"{stage.entrypoint + stage.command}, as {stage.user}")
    with running(image) as process:
        wait_for_health(image, process)
        say("   HEALTHCHECK succeeds")
        client = ["env", f"LODESTREAM_TOKEN={token}", "LODESTREAM_CACHE=/tmp/cache", "python", "-c", _CLIENT]
        code = subprocess.run(image.beside(process, [*client, f"http://127.0.0.1:{stage.port}"]), check=False)
        if code.returncode:
            sys.exit(f"The client ended with {code.returncode}")


def lacking() -> str:
    """Return what this machine lacks, or nothing."""
    if sys.platform != "linux" or os.geteuid():
        return "it is not Linux, or you are not root"
    commands = [name for name in ("debootstrap", "unshare", "nsenter", "ip") if shutil.which(name) is None]
    if commands:
        return f"there is no {' and no '.join(commands)}"
    tried = subprocess.run(["unshare", "--net", "--mount", "--pid", "--fork", "true"], capture_output=True, check=False)
    return f"it gives no namespaces: {tried.stderr.decode().strip()}" if tried.returncode else ""


def main(folder: Path) -> None:
    """Follow the Dockerfile, try the server, and remove the roots."""
    if reason := lacking():
        sys.exit(f"The steps of {DOCKERFILE.relative_to(ROOT)} cannot be run on this machine: {reason}")
    folder /= "image-roots"  # nothing else in the folder is removed
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        image = Image(folder)
        for instruction in instructions(DOCKERFILE.read_text(encoding="utf-8")):
            image.follow(instruction)
        try_server(image)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python .ci/image.py FOLDER")
    main(Path(sys.argv[1]).resolve())
