"""A page from its template: one HTML file that needs nothing but itself."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from .wording import (
    count_text,
    css_gradient,
    decibel_text,
    duration_text,
    hundred_text,
    memory_text,
    percent_text,
    stage_text,
)

TEMPLATES = Path(__file__).resolve().parent


def filled(template: str, **values: object) -> str:
    """The template with its values; those that are no markup are escaped, a missing one is an error."""
    environment = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined)
    environment.filters |= {
        "count": count_text,
        "decibels": decibel_text,
        "duration": duration_text,
        "gradient": css_gradient,
        "hundred": hundred_text,
        "memory": memory_text,
        "percent": percent_text,
        "stage": stage_text,
    }
    return environment.get_template(template).render(**values)
