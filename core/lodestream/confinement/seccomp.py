"""seccomp: which system calls a process may make, by a filter that the kernel runs before each of them.

Calls of the kernel's first thirty years are allowed unless they are named here; of the later ones, which have the same
number everywhere, only those that are named.
"""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import struct
import sys
from collections.abc import Iterable, Mapping

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["restrict"]

_SET_FILTER = 1  # SECCOMP_SET_MODE_FILTER
_ALL_THREADS = 1  # SECCOMP_FILTER_FLAG_TSYNC
_FULL_SPEED = 4  # SECCOMP_FILTER_FLAG_SPEC_ALLOW: or kernels before 5.16 slow everything that computes

_ALLOW, _ERROR, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_LOAD, _EQUAL, _LEAST, _ANY_BIT, _AND, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x54, 0x06

#: Where the filter finds the number of a call, the architecture, and the low halves of its arguments.
_NUMBER, _ARCHITECTURE = 0, 4
_ARGUMENTS = tuple(range(16, 64, 8))

#: Calls beyond this bit are those of x32, whose numbers mean something else.
_X32 = 0x40000000

#: What a build has no use for and a stranger would: the network; other processes; memory and messages that are shared
#: with them; the machine; whatever changes files by their path in a way of which Landlock knows nothing.
_DENIED = """
    socket socketpair bind listen accept accept4 connect sendto sendmsg sendmmsg recvfrom recvmsg recvmmsg shutdown
    ptrace process_vm_readv process_vm_writev kcmp setpgid setsid unshare setns
    setpriority ioprio_set sched_setparam sched_setscheduler sched_setattr
    shmget shmat shmctl shmdt semget semop semtimedop semctl msgget msgsnd msgrcv msgctl memfd_create
    mq_open mq_unlink mq_timedsend mq_timedreceive mq_notify mq_getsetattr
    chmod fchmod fchmodat chown lchown fchown fchownat utime utimes futimesat utimensat mknod mknodat truncate
    setxattr lsetxattr fsetxattr removexattr lremovexattr fremovexattr
    inotify_init inotify_init1 inotify_add_watch fanotify_init fanotify_mark name_to_handle_at open_by_handle_at
    setuid setgid setreuid setregid setresuid setresgid setfsuid setfsgid setgroups capset
    mount umount2 pivot_root chroot acct swapon swapoff reboot sethostname setdomainname iopl ioperm
    init_module finit_module delete_module kexec_load kexec_file_load quotactl bpf perf_event_open userfaultfd
    add_key request_key keyctl settimeofday clock_settime clock_adjtime adjtimex personality syslog vhangup modify_ldt
    lookup_dcookie nfsservctl uselib mbind set_mempolicy migrate_pages move_pages io_setup io_submit
"""

_START = ("fork", "vfork", "execve", "execveat")
_SIGNALS = ("kill", "tkill", "tgkill", "rt_sigqueueinfo", "rt_tgsigqueueinfo")
#: Of which process, says the first argument; 0 is whoever calls.
_LIMITS = ("prlimit64", "sched_setaffinity")

#: From here on the numbers are the same everywhere.
_COMMON = 424
#: close_range, faccessat2, epoll_pwait2, the three of Landlock, futex_waitv, map_shadow_stack, three of futexes, mseal.
#: Not clone3, whose arguments no filter sees: the C library then takes clone.
_LATE = (436, 439, 441, 444, 445, 446, 449, 453, 454, 455, 456, 462)

_NAMESPACES = 0x7E020000
_SAME_PARENT = 0x00008000
_THREAD = 0x00010000
_TRUNCATE, _ACCESS = os.O_TRUNC, os.O_ACCMODE
_SHARED, _ANONYMOUS = 0x01, 0x20
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
#: F_SETOWN, F_SETSIG, F_SETOWN_EX: to whom a pipe sends which signal, SIGKILL perhaps.
_OWNERS = (8, 10, 15)

_X86_64 = """
    mmap 9 shmget 29 shmat 30 shmctl 31 socket 41 connect 42 accept 43 sendto 44 recvfrom 45 sendmsg 46 recvmsg 47
    shutdown 48 bind 49 listen 50 socketpair 53 clone 56 fork 57 vfork 58 execve 59 kill 62 semget 64 semop 65 semctl 66
    shmdt 67 msgget 68 msgsnd 69 msgrcv 70 msgctl 71 truncate 76 chmod 90 fchmod 91 chown 92 fchown 93 lchown 94
    ptrace 101 syslog 103 setuid 105 setgid 106 setpgid 109 setsid 112 setreuid 113 setregid 114 setgroups 116
    setresuid 117 setresgid 119 setfsuid 122 setfsgid 123 capset 126 rt_sigqueueinfo 129 utime 132 mknod 133 uselib 134
    personality 135 vhangup 153 modify_ldt 154 pivot_root 155 prctl 157 adjtimex 159 chroot 161 acct 163
    settimeofday 164 mount 165 umount2 166 swapon 167 swapoff 168 reboot 169 sethostname 170 setdomainname 171 iopl 172
    ioperm 173 init_module 175 delete_module 176 quotactl 179 nfsservctl 180 setxattr 188 lsetxattr 189 fsetxattr 190
    removexattr 197 lremovexattr 198 fremovexattr 199 tkill 200 io_setup 206 io_submit 209 lookup_dcookie 212
    fcntl 72 setpriority 141 sched_setparam 142 sched_setscheduler 144 sched_setaffinity 203 ioprio_set 251
    prlimit64 302 sched_setattr 314
    semtimedop 220 clock_settime 227 tgkill 234 utimes 235 mbind 237 set_mempolicy 238 mq_open 240 mq_unlink 241
    mq_timedsend 242 mq_timedreceive 243 mq_notify 244 mq_getsetattr 245 kexec_load 246 add_key 248 request_key 249
    keyctl 250 inotify_init 253 inotify_add_watch 254 migrate_pages 256 openat 257 mknodat 259 fchownat 260
    futimesat 261 fchmodat 268 unshare 272 move_pages 279 utimensat 280 accept4 288 inotify_init1 294 rt_tgsigqueueinfo
    297 perf_event_open 298 recvmmsg 299 fanotify_init 300 fanotify_mark 301 name_to_handle_at 303 open_by_handle_at 304
    clock_adjtime 305 sendmmsg 307 setns 308 process_vm_readv 310 process_vm_writev 311 kcmp 312 finit_module 313
    seccomp 317 memfd_create 319 kexec_file_load 320 bpf 321 execveat 322 userfaultfd 323 open 2
"""

_AARCH64 = """
    io_setup 0 io_submit 2 setxattr 5 lsetxattr 6 fsetxattr 7 removexattr 14 lremovexattr 15 fremovexattr 16
    lookup_dcookie 18 inotify_init1 26 inotify_add_watch 27 mknodat 33 umount2 39 mount 40 pivot_root 41 nfsservctl 42
    truncate 45 chroot 51 fchmod 52 fchmodat 53 fchownat 54 fchown 55 openat 56 vhangup 58 quotactl 60 utimensat 88
    acct 89 capset 91 personality 92 unshare 97 kexec_load 104 init_module 105 delete_module 106 clock_settime 112
    syslog 116 ptrace 117 kill 129 tkill 130 tgkill 131 rt_sigqueueinfo 138 reboot 142 setregid 143 setgid 144
    setreuid 145 setuid 146 setresuid 147 setresgid 149 setfsuid 151 setfsgid 152 setpgid 154 setsid 157 setgroups 159
    sethostname 161 setdomainname 162 prctl 167 settimeofday 170 adjtimex 171 mq_open 180 mq_unlink 181
    mq_timedsend 182 mq_timedreceive 183 mq_notify 184 mq_getsetattr 185 msgget 186 msgctl 187 msgrcv 188 msgsnd 189
    semget 190 semctl 191 semtimedop 192 semop 193 shmget 194 shmctl 195 shmat 196 shmdt 197 socket 198 socketpair 199
    bind 200 listen 201 accept 202 connect 203 sendto 206 recvfrom 207 shutdown 210 sendmsg 211 recvmsg 212 add_key 217
    request_key 218 keyctl 219 clone 220 execve 221 mmap 222 swapon 224 swapoff 225 mbind 235 set_mempolicy 237
    migrate_pages 238 move_pages 239 rt_tgsigqueueinfo 240 perf_event_open 241 accept4 242 recvmmsg 243
    fanotify_init 262 fanotify_mark 263 name_to_handle_at 264 open_by_handle_at 265 clock_adjtime 266 setns 268
    sendmmsg 269 process_vm_readv 270 process_vm_writev 271 kcmp 272 finit_module 273 seccomp 277 memfd_create 279
    bpf 280 execveat 281 userfaultfd 282 kexec_file_load 294
    fcntl 25 ioprio_set 30 sched_setparam 118 sched_setscheduler 119 sched_setaffinity 122 setpriority 140 prlimit64 261
    sched_setattr 274
"""


def _table(text: str) -> Mapping[str, int]:
    words = text.split()
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))


#: Of each machine, its number for auditors and those of its calls; one that has not all of them lacks the older ones.
_MACHINES = {"x86_64": (0xC000003E, _table(_X86_64)), "aarch64": (0xC00000B7, _table(_AARCH64))}


def restrict(
    libc: ctypes.CDLL, process: int, *, processes: bool, threads: bool = False, descriptors: bool = False
) -> bool:
    """Make no call from now on but those allowed; whether the kernel holds this process to it.

    Parameters
    ----------
    libc : CDLL
    process : int
        The process that calls this, the only one to which it may send signals.
    processes : bool
        Whether further processes may be started. They are sent no signals either, since no filter can tell them from
        others: only Landlock can, from its sixth version on.
    threads : bool
        Whether further threads of this process may be started.
    descriptors : bool
        Whether descriptors may be received.
    """
    machine = os.uname().machine
    if machine not in _MACHINES or sys.maxsize < 1 << 32 or sys.byteorder != "little":
        return False
    architecture, calls = _MACHINES[machine]
    code = b"".join(_program(architecture, calls, process, processes, threads, descriptors))
    instructions = ctypes.create_string_buffer(code, len(code))
    program = struct.pack("HxxxxxxP", len(code) // 8, ctypes.addressof(instructions))
    return bool(libc.syscall(calls["seccomp"], _SET_FILTER, _ALL_THREADS | _FULL_SPEED, program) == 0)


def _program(
    architecture: int, calls: Mapping[str, int], process: int, processes: bool, threads: bool, descriptors: bool
) -> Iterable[bytes]:
    # Each rule falls through to the next one, with the call's number loaded.
    yield _instruction(_LOAD, _ARCHITECTURE)
    yield _instruction(_EQUAL, architecture, 1, 0)
    yield _instruction(_RETURN, _KILL)
    yield _instruction(_LOAD, _NUMBER)
    yield _instruction(_LEAST, _X32, 0, 1)
    yield _instruction(_RETURN, _ERROR | errno.ENOSYS)
    yield _instruction(_LEAST, _COMMON, 0, len(_LATE) + 2)
    for place, number in enumerate(_LATE):
        yield _instruction(_EQUAL, number, len(_LATE) - place, 0)
    yield _instruction(_RETURN, _ERROR | errno.ENOSYS)
    yield _instruction(_RETURN, _ALLOW)
    denied = set(_DENIED.split()) - ({"recvmsg"} if descriptors else set())
    for name in (*sorted(denied), *(() if processes else _START)):
        if name in calls:
            yield _instruction(_EQUAL, calls[name], 0, 1)
            yield _instruction(_RETURN, _ERROR | errno.EPERM)
    for name in _SIGNALS:
        yield from _unless(calls[name], 0, (_EQUAL, process))
    for name in _LIMITS:
        yield from _unless(calls[name], 0, (_EQUAL, 0), (_EQUAL, process))
    for command in _OWNERS:
        yield from _if(calls["fcntl"], 1, (_EQUAL, command))
    if processes:
        yield from _if(calls["clone"], 0, (_ANY_BIT, _NAMESPACES | _SAME_PARENT))
    elif threads:
        # A thread shares memory, files and signals with the process, and cannot be had with a namespace of its own.
        yield from _unless(calls["clone"], 0, (_ANY_BIT, _THREAD))
    else:
        yield _instruction(_EQUAL, calls["clone"], 0, 1)
        yield _instruction(_RETURN, _ERROR | errno.EPERM)
    # The first two versions of Landlock let files be cut that may only be read.
    for name, place in (("open", 1), ("openat", 2)):
        if name in calls:
            yield from _if(calls[name], place, (_ANY_BIT, _TRUNCATE), (_AND, _ACCESS), (_EQUAL, os.O_RDONLY))
    # Memory without a file that is shared with others, to be, does not count as anybody's (RLIMIT_DATA).
    yield from _if(calls["mmap"], 3, (_ANY_BIT, _SHARED), (_ANY_BIT, _ANONYMOUS))
    # A process that ends with its parent keeps doing so.
    yield from _if(calls["prctl"], 0, (_EQUAL, _DEATH_SIGNAL), second=(1, (_EQUAL, int(signal.SIGKILL))))
    yield _instruction(_RETURN, _ALLOW)


def _if(
    number: int, argument: int, *tests: tuple[int, int], second: tuple[int, tuple[int, int]] | None = None
) -> Iterable[bytes]:
    """Refuse a call whose argument passes all of the tests, unless the second one passes its own."""
    body = [(_LOAD, _ARGUMENTS[argument], False)]
    body += [(code, value, code != _AND) for code, value in tests]
    rest = [] if second is None else [(_LOAD, _ARGUMENTS[second[0]], False), (*second[1], True)]
    # After the tests: what the second argument says, the refusal, the number again for the next rule.
    total = len(body) + len(rest) + 1
    yield _instruction(_EQUAL, number, 0, total + 1)
    for place, (code, value, decides) in enumerate(body):
        yield _instruction(code, value, 0, total - place - 1 if decides else 0)
    for place, (code, value, decides) in enumerate(rest, len(body)):
        yield _instruction(code, value, total - place - 1 if decides else 0, 0)
    yield _instruction(_RETURN, _ERROR | errno.EPERM)
    yield _instruction(_LOAD, _NUMBER)


def _unless(number: int, argument: int, *tests: tuple[int, int]) -> Iterable[bytes]:
    """Refuse a call whose argument fails all of the tests."""
    yield _instruction(_EQUAL, number, 0, len(tests) + 3)
    yield _instruction(_LOAD, _ARGUMENTS[argument])
    for place, test in enumerate(tests):
        yield _instruction(*test, len(tests) - place, 0)
    yield _instruction(_RETURN, _ERROR | errno.EPERM)
    yield _instruction(_LOAD, _NUMBER)


def _instruction(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("=HBBI", code, if_true, if_false, value)
