"""A stand-in for the Hugging Face Hub on this machine, as far as repositories of datasets go.

It speaks the protocol that `huggingface_hub` speaks, written down from the requests of that
client: repositories, commits with ordinary and large files, branches, tags, downloads.
"""

import base64
import hashlib
import json
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatch
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

import yaml

TOKEN = "hf_of_alice"
OWNER = "alice"
FIRST_ATTRIBUTES = "".join(
    f"*.{kind} filter=lfs diff=lfs merge=lfs -text\n"
    for kind in ("parquet", "mp4", "png", "jpg")
)
"""Attributes of a new repository of a dataset on the Hub, as far as they matter here."""


@dataclass
class Repository:
    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    """Commit -> its files."""
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    large: set[str] = field(default_factory=set)
    """Files that came as large ones."""
    messages: list[str] = field(default_factory=list)

    def commit(self, branch: str, files: dict[str, bytes], message: str) -> str:
        name = hashlib.sha1(f"{len(self.commits)}{message}".encode()).hexdigest()
        self.commits[name], self.branches[branch] = files, name
        self.messages.append(message)
        return name

    def find(self, revision: str) -> str:
        return (self.branches | self.tags).get(revision, revision)

    def files(self, revision: str = "main") -> dict[str, bytes]:
        return self.commits[self.find(revision)]


class Hub:
    """The stub's state."""

    def __init__(self):
        self.repositories: dict[str, Repository] = {}
        self.blobs: dict[str, bytes] = {}
        self.requests: list[str] = []
        self.endpoint = ""


@contextmanager
def serving_hub():
    hub = Hub()
    handler = type("Handler", (_Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    hub.endpoint = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, format, *args):
        pass

    def do_GET(self):
        self._answer()

    def do_HEAD(self):
        self._answer()

    def do_POST(self):
        self._answer()

    def do_PUT(self):
        self._answer()

    def do_DELETE(self):
        self._answer()

    def _answer(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = unquote(urlsplit(self.path).path)
        self.hub.requests.append(f"{self.command} {path}")
        known = self.headers.get("Authorization") == f"Bearer {TOKEN}"
        if self.command in ("POST", "DELETE") and not known and "validate-yaml" not in path:
            self._send(401, {"error": "Invalid credentials"})
            return
        parts = path.strip("/").split("/")
        if self.command == "PUT" and parts[0] == "blobs":
            assert hashlib.sha256(body).hexdigest() == parts[1]
            self.hub.blobs[parts[1]] = body
            self._send(200, {})
        elif path == "/api/repos/create":
            self._create(json.loads(body))
        elif path == "/api/validate-yaml":
            self._validate(json.loads(body)["content"])
        elif path.endswith(".git/info/lfs/objects/batch"):
            self._batch(json.loads(body))
        elif parts[0] == "api":
            self._of_repository("/".join(parts[2:4]), parts[4:], body)
        elif parts[0] == "datasets":
            self._resolve("/".join(parts[1:3]), parts[4], "/".join(parts[5:]))
        else:
            self._send(404, {"error": path})

    def _create(self, asked):
        name = f"{asked['organization']}/{asked['name']}"
        url = {"url": f"{self.hub.endpoint}/datasets/{name}"}
        if asked["organization"] != OWNER:
            self._send(403, {"error": "You don't have the rights to create a dataset there"})
        elif name in self.hub.repositories:
            self._send(409, {**url, "error": "You already created this dataset repo"})
        else:
            self.hub.repositories[name] = repo = Repository(
                asked.get("visibility") == "private" or asked.get("private", False)
            )
            repo.commit("main", {".gitattributes": FIRST_ATTRIBUTES.encode()}, "initial commit")
            self._send(200, url)

    def _validate(self, content):
        head = yaml.safe_load(content.split("---")[1])
        known = {"mit", "apache-2.0", "cc-by-4.0", None}
        wrong = [] if head.get("license") in known else [{"message": "no such license"}]
        self._send(400 if wrong else 200, {"errors": wrong, "warnings": []})

    def _batch(self, asked):
        objects = []
        for wanted in asked["objects"]:
            action = {"upload": {"href": f"{self.hub.endpoint}/blobs/{wanted['oid']}"}}
            known = wanted["oid"] in self.hub.blobs
            objects.append({**wanted, **({} if known else {"actions": action})})
        self._send(200, {"transfer": "basic", "objects": objects})

    def _of_repository(self, name, parts, body):
        if name not in self.hub.repositories:
            self._send(404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"})
            return
        repo, what = self.hub.repositories[name], parts[0] if parts else ""
        revision = parts[1] if len(parts) > 1 else "main"
        if what in ("tree", "preupload", "commit", "revision", ""):
            if repo.find(revision) not in repo.commits:
                self._send(404, {"error": revision}, {"X-Error-Code": "RevisionNotFound"})
                return
            files = repo.files(revision)
        if what == "tree":
            self._send(
                200,
                [
                    {"type": "file", "path": path, "size": len(content), "oid": _oid(content)}
                    for path, content in files.items()
                ],
            )
        elif what == "preupload":
            lines = files[".gitattributes"].decode().splitlines()
            large = [line.split()[0] for line in lines if "filter=lfs" in line]
            self._send(
                200,
                {
                    "files": [
                        {
                            "path": file["path"],
                            "uploadMode": "lfs"
                            if any(fnmatch(file["path"], name) for name in large)
                            else "regular",
                            "shouldIgnore": False,
                            "oid": _oid(files[file["path"]]) if file["path"] in files else None,
                        }
                        for file in json.loads(body)["files"]
                    ]
                },
            )
        elif what == "commit":
            self._commit(name, repo, revision, body)
        elif what == "refs":
            refs = {
                kind: [
                    {"name": n, "ref": f"refs/{ref}/{n}", "targetCommit": c}
                    for n, c in found.items()
                ]
                for kind, ref, found in (
                    ("branches", "heads", repo.branches),
                    ("tags", "tags", repo.tags),
                )
            }
            self._send(200, refs | {"converts": []})
        elif what == "tag" and self.command == "POST":
            tag = json.loads(body)["tag"]
            taken = tag in repo.tags
            repo.tags.setdefault(tag, repo.find(revision))
            self._send(409 if taken else 200, {"error": "exists"} if taken else {})
        elif what == "tag" and revision in repo.tags:
            repo.tags.pop(revision)
            self._send(200, {})
        elif what == "tag":
            self._send(404, {"error": revision}, {"X-Error-Code": "RevisionNotFound"})
        elif what == "branch":
            taken = revision in repo.branches
            repo.branches.setdefault(revision, repo.branches["main"])
            self._send(409 if taken else 200, {"error": "exists"} if taken else {})
        elif what in ("revision", ""):
            self._send(
                200,
                {
                    "id": name,
                    "sha": repo.find(revision),
                    "private": repo.private,
                    "siblings": [{"rfilename": path} for path in files],
                },
            )
        else:
            self._send(404, {"error": f"{name} {parts}"})

    def _commit(self, dataset, repo, branch, body):
        files, message = dict(repo.files(branch)), ""
        for line in body.decode().splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "header":
                message = value["summary"]
            elif entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.hub.blobs[value["oid"]]
                repo.large.add(value["path"])
            elif entry["key"] == "deletedFile":
                del files[value["path"]]
        name = repo.commit(branch, files, message)
        url = f"{self.hub.endpoint}/datasets/{dataset}/commit/{name}"
        self._send(200, {"commitOid": name, "commitUrl": url})

    def _resolve(self, name, revision, path):
        repo = self.hub.repositories[name]
        content = repo.files(revision).get(path)
        if content is None:
            self._send(404, {"error": path}, {"X-Error-Code": "EntryNotFound"})
            return
        headers = {"X-Repo-Commit": repo.find(revision), "ETag": f'"{_oid(content)}"'}
        self._send(200, content, headers)

    def _send(self, status, content, headers=None):
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for key, value in {"Content-Length": str(len(data)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def _oid(content: bytes) -> str:
    """Git's identifier of a file's content."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
