"""Settings from TOML files and `stage.key=value` overrides, and back; None is "none" in TOML."""

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from gsba.config import RefineSettings
from gsba.log import GsbaError, brief

PRESETS = Path(__file__).parent / "presets"  # folder of settings that come with gsba, by name
_NONE = "none"


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> RefineSettings:
    """Settings of a run: defaults, then the file, then the overrides.

    Args:
        path: TOML file with a table per stage, holding overrides only; or the name of a preset.
        overrides: `stage.key=value` each, the value written as in TOML; bare words are texts.
    Raises:
        GsbaError: unreadable file, unknown key, a value out of range, with the allowed values, or
            overrides that are one text.
    """
    if isinstance(overrides, str):
        raise GsbaError("overrides: give a list of texts, each stage.key=value")
    tree = read_toml(Path(path)) if path else {}
    _check_keys(tree, RefineSettings, (), str(path))
    for override in overrides:
        keys, value = _parse_override(override)
        branch: dict[str, Any] = {}
        _put(branch, keys, value)
        _check_keys(branch, RefineSettings, (), "--set")
        _put(tree, keys, value)
    return validated(_with_none(tree, RefineSettings))


def to_toml(settings: BaseModel) -> str:
    """TOML text of all settings with their allowed values; `load_config` reads it back equal."""
    return "\n".join(_toml_lines(settings, ())) + "\n"


def allowed_settings(settings: BaseModel, place: str = "") -> Iterator[tuple[str, str, str]]:
    """Name `stage.key`, value as in TOML and allowed values, in words, of every setting."""
    model = type(settings)
    for key in model.model_fields:
        value = getattr(settings, key)
        if _nested_model(model, key) is not None:
            yield from allowed_settings(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", _toml_value(value), _allowed(_schema(model, key))


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file, or of the preset of this name. Raises GsbaError: the file cannot be
    read, or is not valid TOML."""
    preset = PRESETS / f"{path}.toml"
    if path.parent == Path() and not path.exists() and preset.is_file():
        path = preset
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise GsbaError(f"cannot read settings {path}: {error.strerror}") from error
    except (
        ValueError,
        RecursionError,
    ) as error:  # bad syntax or encoding, too many digits, nesting
        raise GsbaError(f"{path} is not valid TOML: {error}") from error


def _parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise GsbaError(
            f"--set {brief(text)}: write stage.key=value, e.g. features.max_per_face=600"
        )
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    except (ValueError, RecursionError) as error:  # thousands of digits or brackets
        raise GsbaError(f"--set {brief(text)}: the value is not valid TOML ({error})") from None
    return tuple(part.strip() for part in name.split(".")), parsed


def _put(tree: dict[str, Any], keys: tuple[str, ...], value: Any) -> None:
    for key in keys[:-1]:
        tree = tree.setdefault(key, {})
    tree[keys[-1]] = value


def _check_keys(
    tree: Mapping[str, Any], model: type[BaseModel], place: tuple[str, ...], source: str
) -> None:
    """GsbaError for a key the model does not have, or a value where a table belongs."""
    for key, value in tree.items():
        name = brief(".".join((*place, key)))
        if key not in model.model_fields:
            near = get_close_matches(key[:60], model.model_fields, n=1)
            hint = f"did you mean {near[0]}?" if near else "known: " + ", ".join(model.model_fields)
            raise GsbaError(f"{source}: unknown setting {name}; {hint}")
        nested = _nested_model(model, key)
        if nested is None:
            if isinstance(value, Mapping):
                raise GsbaError(f"{source}: {name} is a value, not a table of settings")
        elif not isinstance(value, Mapping):
            known = ", ".join(nested.model_fields)
            raise GsbaError(f"{source}: {name} is a table of settings ({known}), not a value")
        else:
            _check_keys(value, nested, (*place, key), source)


def _with_none(tree: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Tree in which the text "none" is None where the setting may be None."""
    out: dict[str, Any] = {}
    for key, value in tree.items():
        nested = _nested_model(model, key)
        if nested is not None:
            out[key] = _with_none(value, nested)
        elif value == _NONE and {"type": "null"} in _schema(model, key).get("anyOf", []):
            out[key] = None
        else:
            out[key] = value
    return out


def validated(tree: Mapping[str, Any]) -> RefineSettings:
    """Settings from a tree of values with known keys; GsbaError names a value out of range."""
    tree = _completed(tree, RefineSettings)
    try:
        return RefineSettings.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
    name, model, value = "", RefineSettings, tree
    allowed = ""
    for key in map(str, first["loc"]):
        if model is None or key not in model.model_fields:
            break  # inside a value: an item of a list, an arm of a union
        name, value = f"{name}.{key}".lstrip("."), value[key]
        allowed = _allowed(_schema(model, key))
        model = _nested_model(model, key)
    message = first["msg"].removeprefix("Value error, ")
    if model is not None:  # a check across several settings
        raise GsbaError(f"settings {name}: {message}" if name else message)
    use = message if first["type"] == "value_error" else f"use {allowed}"
    raise GsbaError(f"setting {name} = {brief(_toml_value(value))} is not allowed: {use}")


def _completed(tree: Mapping[str, Any], model: type[BaseModel]) -> dict[str, Any]:
    """Tree whose tables also hold the defaults of that table's field for keys it lacks."""
    out: dict[str, Any] = {}
    for key, value in tree.items():
        nested = _nested_model(model, key)
        default = model.model_fields[key].default
        if nested is not None and isinstance(default, BaseModel) and isinstance(value, Mapping):
            value = default.model_dump() | _completed(value, nested)
        out[key] = value
    return out


def _nested_model(model: type[BaseModel], key: str) -> type[BaseModel] | None:
    annotation: Any = model.model_fields[key].annotation
    is_model = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    return annotation if is_model else None


@cache
def _whole_schema(model: type[BaseModel]) -> dict[str, Any]:
    return model.model_json_schema()


def _schema(model: type[BaseModel], key: str) -> dict[str, Any]:
    """JSON schema of one setting, references to enums resolved."""
    whole = _whole_schema(model)

    def resolve(node: Any) -> Any:
        if isinstance(node, list):
            return [resolve(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return resolve(whole["$defs"][node["$ref"].rsplit("/", 1)[1]])
        return {name: resolve(item) for name, item in node.items()}

    return resolve(whole["properties"][key])


def _allowed(schema: Mapping[str, Any]) -> str:
    """Allowed values of a setting, in words."""
    if "anyOf" in schema:
        return " or ".join(_allowed(arm) for arm in schema["anyOf"])
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return "one of " + ", ".join(json.dumps(choice) for choice in schema["enum"])
    kind = schema.get("type")
    if kind == "array":
        items = [_allowed(item) for item in schema.get("prefixItems", ())]
        return f"a list [{', '.join(items)}]" if items else f"a list of {_allowed(schema['items'])}"
    if kind in ("integer", "number"):
        words = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
        bounds = [f"{sign} {schema[key]:g}" for key, sign in words.items() if key in schema]
        noun = "an integer" if kind == "integer" else "a number"
        noun = "an even integer" if schema.get("multipleOf") == 2 else noun
        return f"{noun} {' and '.join(bounds)}".rstrip()
    if schema.get("minLength"):
        return "a text that is not empty"
    names = {"null": f'"{_NONE}"', "boolean": "true or false", "string": "a text"}
    return names.get(str(kind), "another value")


def _toml_lines(settings: BaseModel, place: tuple[str, ...]) -> Iterator[str]:
    model = type(settings)
    tables = [key for key in model.model_fields if _nested_model(model, key) is not None]
    for key in model.model_fields:
        if key not in tables:
            value = _toml_value(getattr(settings, key))
            yield f"{key} = {value}  # {_allowed(_schema(model, key))}"
    for key in tables:
        nested = getattr(settings, key)
        yield ""
        yield f"[{'.'.join((*place, key))}]  # {(nested.__doc__ or '').splitlines()[0]}"
        yield from _toml_lines(nested, (*place, key))


def _toml_value(value: Any) -> str:
    if value is None:
        return f'"{_NONE}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False, default=str)
