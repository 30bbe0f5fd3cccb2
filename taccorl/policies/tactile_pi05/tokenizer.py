"""The prompt as token numbers: π0.5's tokenizer from the hub or a folder, or bytes, which need neither network nor files."""

from typing import Any

import torch
from lerobot.processor import TokenizerProcessorStep

from taccorl.errors import TaccorlError

BYTES = "bytes"
_PAD, _BEGIN, _FIRST_BYTE = 0, 1, 2


class ByteTokenizer:
    """UTF-8 bytes, behind a token that says where the prompt begins: 258 tokens in all."""

    def __len__(self) -> int:
        return _FIRST_BYTE + 256

    def __call__(self, texts: list[str], **_: Any) -> dict[str, torch.Tensor]:
        """``input_ids`` and ``attention_mask``, (B, longest), filled up at the right."""
        rows = [[_BEGIN, *(_FIRST_BYTE + byte for byte in text.encode())] for text in texts]
        longest = max(len(row) for row in rows)
        ids = torch.tensor([row + [_PAD] * (longest - len(row)) for row in rows])
        mask = torch.tensor([[1] * len(row) + [0] * (longest - len(row)) for row in rows])
        return {"input_ids": ids, "attention_mask": mask}


class PromptTokenizerStep(TokenizerProcessorStep):
    """LeRobot's step with ``bytes`` as one more tokenizer. Never cuts a prompt: its end is the robot's state.

    Saved under its class's path, which LeRobot imports when it loads a checkpoint.
    """

    _registry_name = None  # not LeRobot's step of that name

    def __post_init__(self) -> None:
        """
        Raises:
            TaccorlError: the tokenizer cannot be loaded.
        """
        if self.tokenizer_name == BYTES:
            self.input_tokenizer = ByteTokenizer()
            return
        try:
            super().__post_init__()
        except (OSError, ValueError) as error:
            first = next(iter(str(error).splitlines()), "")
            raise TaccorlError(
                f"--policy.tokenizer={self.tokenizer_name}: cannot be loaded: {first} Without network: a folder with "
                f"tokenizer.json, or {BYTES} where the backbone is trained from scratch"
            ) from error

    def _tokenize_text(self, text: str | list[str]) -> dict[str, torch.Tensor]:
        texts = [text] if isinstance(text, str) else text
        found = self.input_tokenizer(
            texts, truncation=False, padding="longest", padding_side="right", return_tensors="pt"
        )
        length = found["input_ids"].shape[1]
        if length > self.max_length:
            raise TaccorlError(
                f"a prompt of {length} tokens, the policy takes {self.max_length}: {texts[0]!r}. Give a shorter instruction, or "
                f"--policy.tokenizer_max_length={length} when training starts"
            )
        fill = (0, self.max_length - length)
        return {
            "input_ids": torch.nn.functional.pad(found["input_ids"], fill),
            "attention_mask": torch.nn.functional.pad(found["attention_mask"], fill),
        }
