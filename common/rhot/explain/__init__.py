"""Tables of a core's state at one time and of the reasons for its decisions.

A core (`rhot.core`) may implement `explain`; `rhot explain` processes the seconds before a time and then calls it.
"""

from rhot.explain.tables import Explaining, Explanation, ExplanationRow, Outline, PictureExplanation, Verdict

__all__ = ["Explaining", "Explanation", "ExplanationRow", "Outline", "PictureExplanation", "Verdict"]
