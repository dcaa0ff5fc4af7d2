"""What is wrong with a parameter or a body that pydantic refuses: sentences for people, made from its errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["fault_of_body", "faults_of_parameters"]

_SHOWN = 80

# By pydantic's type of error; braces are filled from its context.
_FAULTS: Mapping[str, str] = {
    "missing": "is missing",
    "extra_forbidden": "is not known",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_parsing_size": "must be a whole number that is not so large",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "finite_number": "must be a finite number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be text",
    "string_too_long": "must have at most {max_length} characters",
    "literal_error": "must be {expected}",
    "greater_than_equal": "must be at least {ge:.10g}",
    "less_than_equal": "must be at most {le:.10g}",
    "less_than": "must be less than {lt:.10g}",
    # The regular expression says nothing to most people; the description does, which may go on behind a colon.
    "string_pattern_mismatch": "must be {description}",
}


def faults_of_parameters(errors: Iterable[Mapping[str, Any]], descriptions: Mapping[str, str]) -> str:
    """Return a sentence for each parameter that is wrong.

    Parameters
    ----------
    errors : iterable of mapping
        As FastAPI has them; `loc` begins with where the parameter is, and its name.
    descriptions : mapping of str to str
        What is said of the parameters, by name.
    """
    return "; ".join(_fault_of_parameter(error, descriptions) for error in errors)


def _fault_of_parameter(error: Mapping[str, Any], descriptions: Mapping[str, str]) -> str:
    place, name = error["loc"][:2]
    fault = _fault(error, descriptions.get(name, "written otherwise"))
    got = "" if error["type"] == "missing" else f", and is {str(error['input'])[:_SHOWN]!a}"
    return f"The parameter {name} of the {place} {fault}{got}"


def fault_of_body(error: Mapping[str, Any], expected: str) -> str:
    """Return a sentence about the first thing that is wrong in a body that must be an object in JSON.

    Parameters
    ----------
    error : mapping
        Pydantic's; `loc` is where in the body.
    expected : str
        What the body must be.
    """
    if error["loc"]:
        fault = f"The key {str(error['loc'][-1])[:_SHOWN]!a} of the body {_fault(error, expected)}"
    elif error["type"] == "json_invalid":
        fault = "The body is no JSON"
    else:
        fault = "The body is no object in JSON"
    return f"{fault}; it must be {expected}"


def _fault(error: Mapping[str, Any], description: str) -> str:
    words = _FAULTS.get(error["type"], "cannot be read")
    return words.format(description=description.partition(": ")[0], **error.get("ctx", {}))
