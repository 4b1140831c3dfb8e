"""The way back from noise and masks, with a denoiser whose answer is known."""

import torch

from lerobot_hdp.denoiser import Prediction
from lerobot_hdp.processes import GaussianProcess, MaskedProcess
from lerobot_hdp.sampling import sample_plan


def test_a_token_has_the_probability_with_which_it_was_drawn():
    probabilities = torch.tensor([0.1, 0.2, 0.3, 0.4])

    def denoise(motion, symbols, k_c, k_d):
        return Prediction(torch.zeros_like(motion), probabilities.log().repeat(*symbols.shape, 1))

    processes = GaussianProcess(10, "sample"), MaskedProcess(vocabulary_size=4)
    generator = torch.Generator().manual_seed(0)
    state = sample_plan(
        denoise, *processes, (8, 5, 3), symbolic_horizon=6, device=torch.device("cpu"), num_steps=4, generator=generator
    )
    assert set(state.tokens.flatten().tolist()) == {0, 1, 2, 3}
    torch.testing.assert_close(state.token_probabilities, probabilities[state.tokens])
