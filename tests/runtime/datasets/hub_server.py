"""Stand-in of the Hugging Face hub on loopback, for the hub's own client: datasets, commits, large files, tags."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

TOKEN = "hf_of_the_test"
_LARGE = 1000  # bytes from which a file is uploaded by itself


@dataclass
class Repository:
    """A dataset on the hub: its files, commits and tags; `refs` are the files of each commit."""

    private: bool
    files: dict[str, bytes] = field(default_factory=dict)
    refs: dict[str, dict[str, bytes]] = field(default_factory=dict)
    head: str = "0" * 40

    def commit(self) -> str:
        content = json.dumps({path: sha(data) for path, data in sorted(self.files.items())}) + str(
            len(self.refs)
        )
        self.head = hashlib.sha1(content.encode()).hexdigest()
        self.refs[self.head] = self.refs["main"] = dict(self.files)
        return self.head


@dataclass
class Hub:
    """Everything that the hub has, and what it was told."""

    repositories: dict[str, Repository] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)  # large files by SHA-256
    uploads: list[str] = field(default_factory=list)  # SHA-256 of large files, in the order of their arrival
    operations: list[tuple[str, str]] = field(default_factory=list)  # of commits: what, path
    refused: set[str] = field(default_factory=set)  # tokens that are refused
    tokens: list[str] = field(
        default_factory=list
    )  # of each request but those to a signed address, "" without
    url: str = ""


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@contextmanager
def served_hub() -> Iterator[Hub]:
    """Serve a hub until the block ends."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
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

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

    def _answer(self, status: int, body: Any = None, headers: dict[str, str] | None = None) -> None:
        data = body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        self.send_response(status)
        for name, value in ({"Content-Type": "application/json"} | (headers or {})).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def _handle(self) -> None:
        body, path = self._body(), unquote(urlsplit(self.path).path)
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if not path.startswith("/object/"):
            self.hub.tokens.append(token)
        if not path.startswith("/object/") and (not token or token in self.hub.refused):
            self._answer(401, {"error": "Invalid username or password."})
            return
        for method, pattern, act in _ROUTES:
            if method == self.command and (found := re.fullmatch(pattern, path)):
                act(self, body, *found.groups())
                return
        self._answer(404, {"error": f"{self.command} {path}"})

    do_GET = do_POST = do_PUT = do_HEAD = do_DELETE = _handle

    def _repository(self, name: str) -> Repository | None:
        found = self.hub.repositories.get(name)
        if found is None:
            self._answer(404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"})
        return found

    def create(self, body: bytes) -> None:
        asked = json.loads(body)
        name = f"{asked.get('organization')}/{asked['name']}" if asked.get("organization") else asked["name"]
        if name in self.hub.repositories:
            self._answer(
                409,
                {"error": "You already created this dataset repo", "url": f"{self.hub.url}/datasets/{name}"},
            )
            return
        self.hub.repositories[name] = Repository(
            private=asked.get("visibility") == "private" or bool(asked.get("private"))
        )
        self.hub.repositories[name].commit()
        self._answer(200, {"url": f"{self.hub.url}/datasets/{name}", "name": name, "id": name})

    def whoami(self, body: bytes) -> None:
        self._answer(200, {"type": "user", "name": "lab", "orgs": [], "auth": {"type": "access_token"}})

    def validate(self, body: bytes) -> None:
        head = json.loads(body)["content"].split("---")[1]
        wrong = [] if "license" in head or "tags" in head else [{"message": "no metadata"}]
        self._answer(400 if wrong else 200, {"errors": wrong, "warnings": []})

    def preupload(self, body: bytes, name: str, revision: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        files = [
            {
                "path": row["path"],
                "uploadMode": "lfs" if row["size"] >= _LARGE else "regular",
                "shouldIgnore": False,
                "oid": known_id(repository.files.get(row["path"])),
            }
            for row in json.loads(body)["files"]
        ]
        self._answer(200, {"files": files})

    def batch(self, body: bytes, name: str) -> None:
        objects = []
        for row in json.loads(body)["objects"]:
            href = f"{self.hub.url}/object/{row['oid']}"
            there = row["oid"] in self.hub.objects
            objects.append({**row, **({} if there else {"actions": {"upload": {"href": href}}})})
        self._answer(
            200, {"transfer": "basic", "objects": objects}, {"Content-Type": "application/vnd.git-lfs+json"}
        )

    def store(self, body: bytes, oid: str) -> None:
        if sha(body) != oid:
            self._answer(400, {"error": "another object"})
            return
        self.hub.objects[oid] = body
        self.hub.uploads.append(oid)
        self._answer(200)

    def commit(self, body: bytes, name: str, revision: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        for line in body.splitlines():
            row = json.loads(line)
            key, value = row["key"], row["value"]
            if key == "file":
                repository.files[value["path"]] = base64.b64decode(value["content"])
            elif key == "lfsFile":
                repository.files[value["path"]] = self.hub.objects[value["oid"]]
            elif key == "deletedFile":
                del repository.files[value["path"]]
            if key != "header":
                self.hub.operations.append((key, value["path"]))
        oid = repository.commit()
        url = f"{self.hub.url}/datasets/{name}/commit/{oid}"
        self._answer(200, {"success": True, "commitOid": oid, "commitUrl": url})

    def tag(self, body: bytes, name: str, revision: str) -> None:
        repository, asked = self._repository(name), json.loads(body)
        if repository is None:
            return
        if asked["tag"] in repository.refs:
            self._answer(409, {"error": "Tag exists"})
            return
        repository.refs[asked["tag"]] = repository.refs[revision]
        self._answer(201)

    def untag(self, body: bytes, name: str, tag: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        found = repository.refs.pop(tag, None)
        self._answer(
            404 if found is None else 200,
            {},
            {} if found is not None else {"X-Error-Code": "RevisionNotFound"},
        )

    def about(self, body: bytes, name: str, revision: str = "main") -> None:
        repository = self._repository(name)
        if repository is None:
            return
        files = repository.refs.get(revision)
        if files is None:
            self._answer(404, {"error": "no such revision"}, {"X-Error-Code": "RevisionNotFound"})
            return
        siblings = [
            {"rfilename": path, "size": len(data), "blobId": blob_id(data)} for path, data in files.items()
        ]
        commit = next(ref for ref, held in repository.refs.items() if held == files and len(ref) == 40)
        facts = {"id": name, "private": repository.private, "tags": [], "downloads": 0, "likes": 0}
        self._answer(200, {**facts, "sha": commit, "siblings": siblings})

    def refs(self, body: bytes, name: str) -> None:
        repository = self._repository(name)
        if repository is not None:
            tags = [
                {"name": ref, "ref": f"refs/tags/{ref}", "targetCommit": repository.head}
                for ref in repository.refs
            ]
            tags = [tag for tag in tags if tag["name"] != "main" and len(tag["name"]) < 40]
            branch = {"name": "main", "ref": "refs/heads/main", "targetCommit": repository.head}
            self._answer(200, {"branches": [branch], "tags": tags, "converts": []})

    def tree(self, body: bytes, name: str, revision: str, _folder: str | None = None) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        rows = [
            {
                "type": "file",
                "path": path,
                "oid": blob_id(data),
                "size": len(data),
                **(
                    {"lfs": {"oid": sha(data), "size": len(data), "pointerSize": 130}}
                    if len(data) >= _LARGE
                    else {}
                ),
            }
            for path, data in repository.refs[revision].items()
        ]
        self._answer(200, rows)

    def resolve(self, body: bytes, name: str, revision: str, path: str) -> None:
        repository = self._repository(name)
        if repository is None:
            return
        data = repository.refs[revision].get(path)
        if data is None:
            self._answer(404, {"error": "Entry not found"}, {"X-Error-Code": "EntryNotFound"})
            return
        headers = {
            "ETag": f'"{sha(data)}"',
            "X-Repo-Commit": revision,
            "Content-Type": "application/octet-stream",
        }
        self._answer(200, data, headers)


def known_id(data: bytes | None) -> str | None:
    """Return the id by which the client knows a file that the hub has; None without one."""
    return None if data is None else sha(data) if len(data) >= _LARGE else blob_id(data)


def blob_id(data: bytes) -> str:
    """Return git's id of a file."""
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


_NAME = r"([\w.-]+/[\w.-]+)"
_ROUTES = (
    ("POST", "/api/repos/create", _Handler.create),
    ("GET", "/api/whoami-v2", _Handler.whoami),
    ("POST", "/api/validate-yaml", _Handler.validate),
    ("POST", rf"/api/datasets/{_NAME}/preupload/([\w.]+)", _Handler.preupload),
    ("POST", rf"/datasets/{_NAME}\.git/info/lfs/objects/batch", _Handler.batch),
    ("PUT", r"/object/([0-9a-f]{64})", _Handler.store),
    ("POST", rf"/api/datasets/{_NAME}/commit/([\w.]+)", _Handler.commit),
    ("POST", rf"/api/datasets/{_NAME}/tag/([\w.]+)", _Handler.tag),
    ("DELETE", rf"/api/datasets/{_NAME}/tag/([\w.]+)", _Handler.untag),
    ("GET", rf"/api/datasets/{_NAME}", _Handler.about),
    ("GET", rf"/api/datasets/{_NAME}/revision/([\w.]+)", _Handler.about),
    ("GET", rf"/api/datasets/{_NAME}/refs", _Handler.refs),
    ("GET", rf"/api/datasets/{_NAME}/tree/([\w.]+)(/.*)?", _Handler.tree),
    ("GET", rf"/datasets/{_NAME}/resolve/([\w.]+)/(.+)", _Handler.resolve),
    ("HEAD", rf"/datasets/{_NAME}/resolve/([\w.]+)/(.+)", _Handler.resolve),
)
