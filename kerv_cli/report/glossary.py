"""What the names of settings and columns mean, in about ten words each, for tables and pages."""

from __future__ import annotations

import re
from collections.abc import Iterable

from markupsafe import Markup, escape

METHODS = {
    "ar": "token by token: one run of the policy for each token",
    "early_unverified": "a small network writes every action, nobody verifies it",
    "expert": "Meta-World's scripted expert, which is no policy",
    "heisd": "similar demonstrations draft; very similar ones run unverified",
    "jacobi": "guesses all tokens and corrects them in parallel, without a drafter",
    "kerv": "Spec-VLA; after a rejection a Kalman filter predicts the rest",
    "naive_sd": "a small network drafts, only equal tokens are accepted",
    "one_pass": "a network drafts the action; one run verifies prompt and draft",
    "parallel": "a policy that writes all tokens in one run",
    "retrieval_unverified": "the most similar demonstration runs, nobody verifies it",
    "scout_unverified": "a network with eyes of its own acts, nobody verifies it",
    "sp_vla": "extrapolates fast motion, the policy decodes slow motion",
    "spec_vla": "a small network drafts a tree of tokens, the policy verifies",
}
"""Family of methods -> what it does."""
WORDS = {
    "certified": "skips verification only as far as a test of success allows",
    "chain": "drafts one chain of tokens in place of a tree",
    "code": "as in the public code, where the paper says otherwise",
    "literal": "the paper's formula, word for word",
    "skip": "drafts that are similar enough run unverified",
    "streak": "after drafts that agree, more of them run unverified",
    "strict": "accepts only tokens that equal the policy's",
    "tuned": "changed by us, to suit these policies",
}
"""Word in the name of a setting -> what it says."""
UNVERIFIED = "executed tokens that the policy neither wrote nor accepted"


def explained(label: str, method: str = "") -> str:
    """Explain the label of a setting, word by word. Empty if none of its words is in the glossary.

    Args:
        label: The setting's label, such as `spec_vla chain`.
        method: The setting's method, such as `spec_vla`. Empty: the label's first word.
    """
    method = method or re.split(r"[ ,]", label)[0]
    family = max((name for name in METHODS if method == name or method.startswith(f"{name}_")), key=len, default="")
    rest = f"{method.removeprefix(family)} {label.removeprefix(method)}" if family else f"{method} {label}"
    words = [text for word, text in WORDS.items() if word in re.split(r"[\W_]+", rest)]
    return "; ".join(filter(None, (METHODS.get(family, ""), *words)))


def explanations(settings: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Explain a table's settings, and its column *tokens unverified*.

    Args:
        settings: Label and method of each setting.

    Returns:
        A dictionary from label or heading to explanation. Settings whose names have no known word are left out.
    """
    found = {}
    for label, method in settings:
        if text := explained(label, method):
            found[label] = text
    return found | {"tokens unverified": UNVERIFIED}


def with_code(text: str) -> Markup:
    """Return a text as HTML. Words in backticks become <code> elements. Templates use this function as a filter."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
