"""PPO in plain PyTorch: `python torch_ppo.py walker2d 4096 50_000_000`."""

import sys

import torch
from torch import nn

import mjx_walk

task, num_envs, total_steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
torch.manual_seed(0)
env = mjx_walk.make_torch_env(task, num_envs)
num_obs, num_actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]
length, epochs, minibatches, gamma, lam, clip = 32, 4, 32, 0.99, 0.95, 0.2


def network(outputs: int) -> nn.Sequential:
    normalize = nn.BatchNorm1d(num_obs, affine=False, momentum=None)  # running mean and std of the observations
    layers = [nn.Linear(num_obs, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), nn.Linear(256, outputs)]
    return nn.Sequential(normalize, *layers).to(env.device).eval()


policy, critic = network(num_actions), network(1)
log_std = nn.Parameter(torch.full((num_actions,), -0.5, device=env.device))
parameters = [*policy.parameters(), *critic.parameters(), log_std]
optimizer = torch.optim.Adam(parameters, lr=3e-4)
low, high = (torch.as_tensor(x, device=env.device) for x in (env.single_action_space.low, env.single_action_space.high))
obs, _ = env.reset(seed=0)
iterations = max(1, total_steps // (length * num_envs))
for iteration in range(iterations):
    steps, ended = [], []
    with torch.no_grad():
        for _ in range(length):
            noise = torch.distributions.Normal(policy(obs), log_std.exp())
            action = noise.sample()
            old_obs, log_prob = obs, noise.log_prob(action).sum(-1)
            scaled = low + (high - low) * (action.clip(-1, 1) + 1) / 2
            obs, reward, terminated, truncated, info = env.step(scaled)
            next_value = critic(info["final_obs"])[:, 0] * ~terminated
            steps.append((old_obs, action, log_prob, reward, critic(old_obs)[:, 0], next_value, terminated | truncated))
            ended.append(info["episode"]["r"][info["_episode"]])
        obs_, action_, log_prob_, reward_, value_, next_value_, over_ = map(torch.stack, zip(*steps, strict=True))
        delta, advantage, later = reward_ * 0.1 + gamma * next_value_ - value_, torch.zeros_like(value_), 0
        for t in reversed(range(length)):
            later = advantage[t] = delta[t] + gamma * lam * ~over_[t] * later
        target = advantage + value_
        data = [x.flatten(0, 1) for x in (obs_, action_, log_prob_, advantage, target)]
    optimizer.param_groups[0]["lr"] = 3e-4 * (1 - iteration / iterations)
    for _ in range(epochs):
        for rows in torch.randperm(len(target.flatten()), device=env.device).chunk(minibatches):
            o, a, old, adv, ret = (x[rows] for x in data)
            ratio = (torch.distributions.Normal(policy(o), log_std.exp()).log_prob(a).sum(-1) - old).exp()
            adv = (adv - adv.mean()) / (adv.std() + 1e-8)
            loss = -torch.min(ratio * adv, ratio.clip(1 - clip, 1 + clip) * adv).mean()
            loss = loss + 0.5 * (critic(o)[:, 0] - ret).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimizer.step()
    for net in (policy, critic):  # after the updates, so that a batch is learned with the scale it was collected with
        net[0].train()(data[0])
        net.eval()
    done = torch.cat(ended)
    if len(done):
        print(f"{(iteration + 1) * length * num_envs:>12,} steps  return {done.mean():.1f}  episodes {len(done)}")
