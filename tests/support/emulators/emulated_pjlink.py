"""A PJLink projector of class 1, from the standard (version 1.04), on a loopback port."""

import hashlib
import socketserver
import threading
import time

INPUTS = ("11", "31", "32")


class PJLinkProjector(socketserver.ThreadingTCPServer):
    """What is set may be set at any time, from any thread."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, password: str | None = None) -> None:
        self.password = password
        self.salt: str | None = None
        """The random number of every greeting; None: another one each time."""
        self.warming_s = 0.0
        self.cooling_s = 0.0
        self.settling_s = 0.0
        """How long it goes on saying what it was, after it took a command."""
        self.input = "11"
        self.mute = "30"
        self.errors = "000000"
        self.lamps = "1234 1"
        self.fixed: dict[str, str] = {}
        """Answers to commands by their four letters, whatever was asked."""
        self.greeting: bytes | None = None
        """Said in place of the standard's."""
        self.before_answer = b""
        self.delay_s = 0.0
        self.silent = False
        self.rambles = False
        """Says again and again, for half a minute, what was not asked."""
        self.hangs_up_after: int | None = None
        """After how many answers it closes a connection instead of answering."""
        self.connections = 0
        self.received: list[str] = []
        """Commands without what goes before the first of a connection."""
        self.digests: list[str] = []
        self._power, self._since = "0", float("-inf")
        super().__init__(("127.0.0.1", 0), _Connection)
        self.url = f"socket://127.0.0.1:{self.server_address[1]}"
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def __exit__(self, *args: object) -> None:
        self.shutdown()
        super().__exit__(*args)

    @property
    def power(self) -> str:
        """0 standby, 1 on, 2 cooling, 3 warming."""
        age_s = time.monotonic() - self._since
        if self._power == "1":
            return "0" if age_s < self.settling_s else "3" if age_s < self.settling_s + self.warming_s else "1"
        return "1" if age_s < self.settling_s else "2" if age_s < self.settling_s + self.cooling_s else "0"

    def switch(self, on: bool) -> None:
        """Switch it on or off with its own button."""
        self._power, self._since = "1" if on else "0", time.monotonic()

    def answer(self, command: str, parameter: str) -> str:
        """Obey a command; return what comes behind the = of its answer."""
        if command in self.fixed:
            return self.fixed[command]
        power = self.power
        if command == "POWR" and parameter == "?":
            return power
        if command == "POWR" and parameter in ("0", "1"):
            if power in "23":
                return "ERR3"
            if parameter != power:
                self.switch(parameter == "1")
            return "OK"
        if command == "INPT" and parameter != "?":
            if parameter not in INPUTS:
                return "ERR2"
            if power != "1":
                return "ERR3"
            self.input = parameter
            return "OK"
        if command == "AVMT" and parameter != "?":
            if parameter not in ("10", "11", "20", "21", "30", "31"):
                return "ERR2"
            if power != "1":
                return "ERR3"
            self.mute = parameter
            return "OK"
        if parameter != "?":
            return "ERR2"
        if command in ("INPT", "AVMT"):
            return "ERR3" if power != "1" else self.input if command == "INPT" else self.mute
        told = {"ERST": self.errors, "LAMP": self.lamps, "INST": " ".join(INPUTS), "INF1": "ACME", "INF2": "X-1"}
        return told.get(command, "ERR1")


class _Connection(socketserver.BaseRequestHandler):
    server: PJLinkProjector

    def handle(self) -> None:
        projector = self.server
        projector.connections += 1
        salt = projector.salt or f"{projector.connections * 2654435761 % 2**32:08x}"
        locked = projector.password is not None
        self._say(projector.greeting or (f"PJLINK 1 {salt}\r" if locked else "PJLINK 0\r").encode())
        arrived = b""
        n_answered = 0
        while True:
            try:
                more = self.request.recv(4096)
            except OSError:
                return
            if not more:
                return
            arrived += more
            while b"\r" in arrived:
                line, arrived = arrived.split(b"\r", 1)
                text = line.decode()
                assert len(text) <= 136 + 32
                if locked:
                    # Only the first command of a connection proves that its sender knows the password.
                    digest, text = text[:32], text[32:]
                    projector.digests.append(digest)
                    if digest != hashlib.md5((salt + (projector.password or "")).encode()).hexdigest():
                        self._say(b"PJLINK ERRA\r")
                        return
                    locked = False
                projector.received.append(text)
                if n_answered == projector.hangs_up_after:
                    return
                if projector.silent:
                    continue
                for _ in range(300 * projector.rambles):
                    if not self._say(b"%1LAMP=99 0\r"):
                        return
                    time.sleep(0.1)
                time.sleep(projector.delay_s)
                if text[:2] != "%1" or text[6:7] != " ":
                    self._say(b"%1" + text[2:6].encode() + b"=ERR1\r")
                    continue
                said = projector.answer(text[2:6].upper(), text[7:])
                self._say(projector.before_answer + f"%1{text[2:6]}={said}\r".encode())
                n_answered += 1

    def _say(self, text: bytes) -> bool:
        """Return whether somebody listens."""
        try:
            self.request.sendall(text)
        except OSError:
            return False
        return True
