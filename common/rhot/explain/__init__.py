"""What a core knew at one moment and why it decided as it did, as tables for people.

A stage (`rhot.stage`) may offer `explain`; `rhot explain` runs the stages over the seconds before a moment and asks.
"""

from rhot.explain.tables import Explaining, Explanation, ExplanationRow, Outline, PictureExplanation, Verdict

__all__ = ["Explaining", "Explanation", "ExplanationRow", "Outline", "PictureExplanation", "Verdict"]
