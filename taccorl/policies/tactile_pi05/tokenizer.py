"""The prompt as token numbers: π0.5's tokenizer from the hub or a folder; words or bytes, which need neither network nor files.

π0.5's prompt ends with the robot's state, a number 0 … 255 for each joint (−1: below the range). As bytes, a policy that is
trained from scratch has to learn first what digits mean, and reads three times as many tokens as there are words and numbers.
"""

import math
import re
import zlib
from pathlib import Path
from typing import Any

import torch
from lerobot.processor import TokenizerProcessorStep

from taccorl.errors import TaccorlError

BYTES, WORDS = "bytes", "words"
_PAD, _BEGIN, _FIRST = 0, 1, 2
_LOWEST, _HIGHEST = (
    -1,
    255,
)  # numbers with a token of their own: π0.5's bins of the state
_NUM_NUMBERS = _HIGHEST - _LOWEST + 1
_NUM_WORDS = 256
_PIECES = re.compile(r"-?\d+|[^\W\d]+|[^\w\s]")  # numbers, words, signs


class ByteTokenizer:
    """Tokenizer of UTF-8 bytes with a token for the start of the prompt: 258 tokens in all."""

    def __len__(self) -> int:
        return _FIRST + 256

    def tokens(self, text: str) -> list[int]:
        """Return the token numbers of one prompt, without padding."""
        return [_BEGIN, *(_FIRST + byte for byte in text.encode())]

    def __call__(self, texts: list[str], **_: Any) -> dict[str, torch.Tensor]:
        """Return ``input_ids`` (int64) and ``attention_mask`` of the B prompts ``texts``, (B, longest) each, padded on the
        right."""
        rows = [self.tokens(text) for text in texts]
        longest = max(len(row) for row in rows)
        ids = torch.tensor([row + [_PAD] * (longest - len(row)) for row in rows])
        mask = torch.tensor(
            [[1] * len(row) + [0] * (longest - len(row)) for row in rows]
        )
        return {"input_ids": ids, "attention_mask": mask}

    def save_pretrained(self, save_directory: str | Path, **_: Any) -> tuple[str, ...]:
        """Files written into a checkpoint, as a tokenizer of transformers returns them:
        none. The step's ``tokenizer_name`` says all."""
        return ()


class WordTokenizer(ByteTokenizer):
    """A token for each number −1 … 255, and one of 256 for each word or sign, by its CRC-32: 515 tokens in all.

    Two words may share a token (the hashing trick): 1 in 256. Instructions of a dataset that differ in nothing else would then
    be one; ``bytes`` tells all of them apart."""

    def __len__(self) -> int:
        return _FIRST + _NUM_NUMBERS + _NUM_WORDS

    def tokens(self, text: str) -> list[int]:
        """Return the token numbers of one prompt, without padding."""
        return [_BEGIN, *(self._token(piece) for piece in _PIECES.findall(text))]

    @staticmethod
    def _token(piece: str) -> int:
        if piece[-1].isdigit() and _LOWEST <= int(piece) <= _HIGHEST:
            return _FIRST + int(piece) - _LOWEST
        return _FIRST + _NUM_NUMBERS + zlib.crc32(piece.lower().encode()) % _NUM_WORDS


def write_number_embeddings(embedding_VD: torch.Tensor) -> None:
    """Initialise the embeddings (vocabulary, D) of ``WordTokenizer``'s numbers so that similar numbers have similar embeddings:
    sines and cosines of ½ … 128 half periods over the range, of the size of the others. With random embeddings each number would
    be learned separately."""
    numbers = (
        torch.arange(_NUM_NUMBERS, device=embedding_VD.device)[:, None] / _NUM_NUMBERS
    )
    half_turns = 2.0 ** torch.linspace(
        -1, 7, embedding_VD.shape[1] // 2, device=embedding_VD.device
    )
    waves = torch.cat(
        [trig(math.pi * numbers * half_turns) for trig in (torch.sin, torch.cos)], dim=1
    )
    rest = embedding_VD[_FIRST + _NUM_NUMBERS :]
    with torch.no_grad():
        embedding_VD[_FIRST : _FIRST + _NUM_NUMBERS] = waves * math.sqrt(2) * rest.std()


_SHIPPED = {BYTES: ByteTokenizer, WORDS: WordTokenizer}


class PromptTokenizerStep(TokenizerProcessorStep):
    """LeRobot's step with ``words`` and ``bytes`` as additional tokenizers. A prompt is never truncated, because the robot's
    state is at its end. A checkpoint names the step by its class's path, which LeRobot imports when it loads a checkpoint."""

    _registry_name = None  # not LeRobot's step of that name

    def __post_init__(self) -> None:
        """Raises TaccorlError: the tokenizer cannot be loaded."""
        if self.tokenizer_name in _SHIPPED:
            self.input_tokenizer = _SHIPPED[self.tokenizer_name]()
            return
        try:
            super().__post_init__()
        except (OSError, ValueError) as error:
            first = next(iter(str(error).splitlines()), "")
            raise TaccorlError(
                f"--policy.tokenizer={self.tokenizer_name}: cannot be loaded: {first} Without network, give a folder with "
                f"tokenizer.json, or {' or '.join(_SHIPPED)} for a backbone that is trained from scratch"
            ) from error

    def _tokenize_text(self, text: str | list[str]) -> dict[str, torch.Tensor]:
        texts = [text] if isinstance(text, str) else text
        different = list(
            dict.fromkeys(texts)
        )  # hundreds of rows of a batch share a handful of instructions
        found = self.input_tokenizer(
            different,
            truncation=False,
            padding="longest",
            padding_side="right",
            return_tensors="pt",
        )
        length = found["input_ids"].shape[1]
        if length > self.max_length:
            raise TaccorlError(
                f"a prompt has {length} tokens, but the policy takes {self.max_length}: {texts[0]!r}. Give a shorter "
                f"instruction, or --policy.tokenizer_max_length={length} when training starts"
            )
        fill = (0, self.max_length - length)
        place = {text: row for row, text in enumerate(different)}
        rows = torch.tensor([place[text] for text in texts])
        return {
            "input_ids": torch.nn.functional.pad(found["input_ids"], fill)[rows],
            "attention_mask": torch.nn.functional.pad(found["attention_mask"], fill)[
                rows
            ],
        }
