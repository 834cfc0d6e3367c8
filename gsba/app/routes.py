"""Requests of the page and their answers, as JSON and files."""

import json
import shlex
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from gsba.app import drops, runs
from gsba.app.browse import inside, listing
from gsba.app.hub import App
from gsba.app.jobs import ACTIVE, AppJob, Command
from gsba.app.worker import ensure_worker
from gsba.log import GsbaError
from gsba.view.server import allowed

_UPLOAD = "/upload"
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
PAGE = {one.name: one for one in (files("gsba.app") / "page").iterdir() if one.name[0] != "."}
_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Reports may come from somebody else's run: they must not reach the page's requests.
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:"
)
_SHOWN = {".html": "text/html", ".png": "image/png", ".svg": "image/svg+xml"}
_HINT = "Forbidden: open the address that gsba app printed.\n"

Handler = Callable[[App, Request], Any]


def application(app: App) -> ASGIApp:
    """The ASGI application of a server; every request needs the token as its first component."""
    table: dict[str, tuple[str, Handler]] = {
        "/api/start": ("GET", _start),
        "/api/browse": ("GET", _browse),
        "/api/info": ("GET", _info),
        "/api/jobs": ("GET", _jobs),
        "/api/jobs/{id}": ("GET", _job),
        "/api/jobs/{id}/map": ("GET", _job_map),
        "/api/jobs/{id}/log": ("GET", _job_log),
        "/api/about": ("POST", _about),
        "/api/picture": ("GET", _picture),
        "/api/drop": ("POST", _drop),
        "/api/discard": ("POST", _discard),
        "/api/command": ("POST", _command),
        "/api/run": ("GET", _run),
        "/api/run/map": ("GET", _run_map),
        "/api/add": ("POST", _add),
        "/api/jobs/{id}/{action:str}": ("POST", _act),
        "/api/view": ("POST", _view),
        "/files/{path:path}": ("GET", _file),
        "/{name}": ("GET", _page),
        "/": ("GET", _page),
    }
    routes = [
        Route(path, _answering(app, handler), methods=[method])
        for path, (method, handler) in table.items()
    ]
    routes.append(Route(_UPLOAD, _receiving(app), methods=["POST"]))
    return _Guard(Starlette(routes=routes), app.token)


class _Guard:
    """ASGI application that refuses requests without the token, and strips it from the path."""

    def __init__(self, inner: ASGIApp, token: str) -> None:
        self._inner, self._token = inner, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        path = scope["path"]
        # A request that changes something must come from the page: a form of another page cannot
        # send these types without asking first.
        kind = headers.get("content-type", "").partition(";")[0]
        upload = path == f"/{self._token}{_UPLOAD}"
        wanted = "application/octet-stream" if upload else "application/json"
        not_a_form = scope["method"] in ("GET", "HEAD") or kind == wanted
        if not (not_a_form and allowed(hosts, origins, path, self._token)):
            await PlainTextResponse(_HINT, 403)(scope, receive, send)
            return
        rest = path.removeprefix(f"/{self._token}")
        inner = {**scope, "path": rest or "/", "raw_path": (rest or "/").encode()}

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message["headers"],
                    (b"referrer-policy", b"no-referrer"),
                    (b"x-content-type-options", b"nosniff"),
                    (b"cache-control", b"no-store"),
                ]
            await send(message)

        await self._inner(inner, receive, send_with_headers)


def _answering(app: App, handler: Handler) -> Callable[[Request], Awaitable[Response]]:
    """Endpoint whose handler runs in a thread and whose expected failures are one line."""

    async def answer(request: Request) -> Response:
        if request.method == "POST":
            body = b""
            async for chunk in request.stream():
                body += chunk
                if len(body) > 256 * 1024:
                    return JSONResponse({"error": "the request is too long"}, 413)
            try:
                request.state.body = json.loads(body or b"{}")
                if not isinstance(request.state.body, dict):
                    raise ValueError
            except (ValueError, RecursionError):
                return JSONResponse({"error": "the request is no JSON object"}, 400)
        try:
            found = await run_in_threadpool(handler, app, request)
        except GsbaError as error:
            return JSONResponse({"error": str(error)}, 400)
        except OSError as error:
            return JSONResponse({"error": f"{error.filename or ''}: {error.strerror}"}, 400)
        return found if isinstance(found, Response) else JSONResponse(found)

    return answer


def _receiving(app: App) -> Callable[[Request], Awaitable[Response]]:
    """Endpoint that appends its body to a dropped file."""

    async def answer(request: Request) -> Response:
        query = request.query_params
        try:
            numbers = [int(query[name]) for name in ("size", "modified", "offset")]
        except (KeyError, ValueError):
            return JSONResponse({"error": "the request is no part of a file"}, 400)
        try:
            path = query.get("path", "")
            arrival = await run_in_threadpool(drops.Arrival, app.root, path, *numbers)
            try:
                async for chunk in request.stream():
                    await run_in_threadpool(arrival.write, chunk)
                found = await run_in_threadpool(arrival.finish)
            finally:
                arrival.close()
        except GsbaError as error:
            return JSONResponse({"error": str(error)}, 400)
        except ClientDisconnect:  # the page was closed: what has arrived stays
            return JSONResponse({"error": "the page was closed"}, 400)
        return JSONResponse(found)

    return answer


def _page(app: App, request: Request) -> Response:
    file = PAGE.get(request.path_params.get("name", "index.html"))
    if file is None:
        return PlainTextResponse("Not found\n", 404)
    kind, policy = _TYPES[Path(file.name).suffix], {"content-security-policy": _PAGE_POLICY}
    return Response(file.read_bytes(), media_type=kind, headers=policy)


def _start(app: App, request: Request) -> Any:
    """All that a page needs once: the forms of commands and known values of fields."""
    forms = {name: asdict(form) for name, form in app.forms.items()}
    return {"root": str(app.root), "forms": forms, "choices": app.choices}


def _browse(app: App, request: Request) -> Any:
    name = request.query_params.get("path", "")
    return listing(app.root, name) | {"unfinished": drops.unfinished(inside(app.root, name))}


def _about(app: App, request: Request) -> Any:
    """Facts about several paths and whether they have a picture, as far as known, by path."""
    names = request.state.body.get("paths")
    if not isinstance(names, list):
        raise GsbaError("the request names no paths")
    names = [str(name) for name in names[:200]]
    found = app.previews.about([inside(app.root, name) for name in names])
    return {"about": dict(zip(names, found, strict=True))}


def _picture(app: App, request: Request) -> Response:
    """A small picture of a path, a panorama at a place of it, or that of a run's frame."""
    query = request.query_params
    path = inside(app.root, query.get("path", ""))
    try:
        if "frame" in query:
            made = app.previews.frame(path, int(query["frame"]))
        elif "at" in query:
            made = app.previews.panorama(path, float(query["at"]))
        else:
            made = app.previews.picture(path)
    except ValueError:
        raise GsbaError("the place of a picture is no number") from None
    return FileResponse(made, media_type="image/jpeg")


def _drop(app: App, request: Request) -> Any:
    body = request.state.body
    if not isinstance(body.get("files"), list):
        raise GsbaError("the request names no files")
    return {"files": drops.plan(app.root, str(body.get("folder", "")), body["files"])}


def _discard(app: App, request: Request) -> Any:
    body = request.state.body
    drops.discard(app.root, str(body.get("folder", "")), str(body.get("part", "")))
    return {}


def _info(app: App, request: Request) -> Any:
    path = inside(app.root, request.query_params.get("path", ""))
    return app.previews.facts(path) | {"path": path.relative_to(app.root).as_posix()}


def _jobs(app: App, request: Request) -> Any:
    return {"jobs": [_row(app, job) for job in reversed(app.jobs.all())]}


def _job(app: App, request: Request) -> Any:
    job = app.jobs.get(request.path_params["id"])
    found = _row(app, job) | {"progress": app.progress(job).table()}
    if job.command.run is not None and job.command.arguments[0] == "refine":
        run = inside(app.root, job.command.run)
        found["camera"] = runs.camera_so_far(run, app.progress(job).names())
    if job.command.run is not None and job.command.arguments[0] == "plot":
        drawn = sorted(inside(app.root, job.command.run).glob("*.png"))
        found["figures"] = [path.relative_to(app.root).as_posix() for path in drawn]
    return found


def _job_map(app: App, request: Request) -> Any:
    job = app.jobs.get(request.path_params["id"])
    return runs.map_so_far(inside(app.root, job.command.run or ""), app.progress(job))


def _job_log(app: App, request: Request) -> Response:
    job = app.jobs.get(request.path_params["id"])
    content = job.log.read_bytes()[-64 * 1024 :] if job.log.is_file() else b""
    return PlainTextResponse(content.decode("utf-8", "replace"))


def _command(app: App, request: Request) -> Any:
    """The command line of a form's values, and why it would be refused, if it would."""
    command = ""
    try:
        arguments = _arguments(app, request.state.body)
        command = _line(arguments)
        app.check(arguments)
    except GsbaError as error:
        return {"command": command, "error": str(error)}
    return {"command": command, "error": ""}


def _add(app: App, request: Request) -> Any:
    body = request.state.body
    arguments = _arguments(app, body)
    app.check(arguments)
    values = body.get("values", {})
    run = values.get("run")
    if arguments[0] != "export":  # a run that grows is written in place, or elsewhere
        run = values.get("out") or run
    if arguments[0] == "refine" and not (values.get("frames") or values.get("recording")):
        raise GsbaError("frames are missing: choose a video or a folder")
    if arguments[0] == "refine" and not run:
        raise GsbaError("--out is missing: name the folder of the run")
    job = app.jobs.add(Command(tuple(arguments), str(app.root), run))
    ensure_worker(app.jobs)
    return _row(app, job)


def _arguments(app: App, body: dict[str, Any]) -> list[str]:
    """Arguments of the form that a request names; paths must be below the root."""
    form, values = app.forms.get(str(body.get("command"))), body.get("values")
    if form is None or not isinstance(values, dict):
        raise GsbaError("the request names no command of the page")
    arguments = form.arguments(values)
    for path in form.paths(values):
        inside(app.root, path)
    return arguments


def _act(app: App, request: Request) -> Any:
    name, action = request.path_params["id"], request.path_params["action"]
    if action == "stop":
        return _row(app, app.jobs.stop(name))
    if action == "go-on":
        job = app.jobs.go_on(name)
        ensure_worker(app.jobs)
        return _row(app, job)
    if action == "remove":
        app.jobs.remove(name)
        return {}
    raise GsbaError(f"a job cannot {action}")


def _run(app: App, request: Request) -> Any:
    name = request.query_params.get("path", "")
    return {"path": name} | runs.overview(inside(app.root, name))


def _run_map(app: App, request: Request) -> Any:
    return runs.finished_map(inside(app.root, request.query_params.get("path", "")))


def _view(app: App, request: Request) -> Any:
    return {"address": app.view(inside(app.root, str(request.state.body.get("path", ""))))}


def _file(app: App, request: Request) -> Response:
    """A file of a run: shown if it is a report or a figure, else a download."""
    path = inside(app.root, request.path_params["path"])
    if not path.is_file():
        return PlainTextResponse("Not found\n", 404)
    kind = _SHOWN.get(path.suffix.lower())
    if kind is None:
        return FileResponse(path, filename=path.name)
    return FileResponse(path, media_type=kind, headers={"content-security-policy": _REPORT_POLICY})


def _row(app: App, job: AppJob) -> dict[str, Any]:
    """A job for lists."""
    state, progress = job.state, app.progress(job)
    active = state.status in ACTIVE
    return {
        "id": job.id,
        "kind": job.command.arguments[0],
        "run": job.command.run,
        "command": _line(job.command.arguments),
        "status": state.status,
        "code": state.code,
        "began": state.began,
        "ended": state.ended,
        "forced": state.forced,
        "stage": progress.stage["title"] if active and progress.stage else "",
        "error": "" if active or state.status == "waiting" else progress.error,
    }


def _line(arguments: Any) -> str:
    return shlex.join(["gsba", *arguments])
