"""Stands between libfranka and a control box, and loses some of the packets between them.

Commands by TCP pass unchanged, but for the port by which states shall be sent: they come here.
"""

import random
import select
import socket
import struct
import sys

_PORT = 1337
_HEADER = struct.Struct("<III")  # command, its number, size with this header
_CONNECT = struct.Struct("<HH")  # version, port for the states


def serve(host: str, server: str, loss: float) -> None:
    rng = random.Random(7)
    listener = socket.create_server((host, _PORT))
    print("listening", flush=True)
    while True:
        client, (address, _) = listener.accept()
        try:
            with client, socket.create_connection((server, _PORT)) as box:
                _pass_on(client, box, address, loss, rng)
        except OSError:
            continue


def _pass_on(
    client: socket.socket, box: socket.socket, address: str, loss: float, rng: random.Random
) -> None:
    for way in (client, box):
        way.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    to_client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    to_box = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    to_client.bind(("0.0.0.0", 0))
    to_box.bind(("0.0.0.0", 0))
    hello = client.recv(_HEADER.size + _CONNECT.size, socket.MSG_WAITALL)
    version, port = _CONNECT.unpack(hello[_HEADER.size :])
    ours = _CONNECT.pack(version, to_box.getsockname()[1])
    box.sendall(hello[: _HEADER.size] + ours)
    source = None
    while True:
        for ready in select.select([client, box, to_client, to_box], [], [])[0]:
            if ready in (client, box):
                data = ready.recv(65536)
                if not data:
                    return
                (box if ready is client else client).sendall(data)
            elif ready is to_box:
                data, source = to_box.recvfrom(65536)
                if rng.random() >= loss:
                    to_client.sendto(data, (address, port))
            else:
                data = to_client.recv(65536)
                if source is not None and rng.random() >= loss:
                    to_box.sendto(data, source)


if __name__ == "__main__":
    serve(sys.argv[1], sys.argv[2], float(sys.argv[3]))
