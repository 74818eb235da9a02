"""Train your own network in your own loop on an Arrow dataset, without dmrl's trainer.

Run it in an empty folder: python own_network.py
"""

import torch
from torch import nn

import dmrl

dmrl.sketch("pictures", images=96, seed=1)
pictures = dmrl.convert("pictures", "pictures.mcap")
data = dmrl.make_dataset([pictures], "dataset")
train, test = data["train"], data["test"]
print(data, len(train), "images to learn from")

# Three convolutions give a confidence and a depth for each cell of 8 x 8 pixels.
torch.manual_seed(1)
network = nn.Sequential(
    nn.Conv2d(3, 16, 5, stride=4, padding=2),
    nn.ReLU(),
    nn.Conv2d(16, 32, 3, stride=2, padding=1),
    nn.ReLU(),
    nn.Conv2d(32, 2, 3, padding=1),
)
optimizer = torch.optim.Adam(network.parameters(), 3e-3)
# About one cell in a thousand shows a robot, so positive cells get more weight.
confidence_loss = nn.BCEWithLogitsLoss(pos_weight=torch.tensor(200.0))

for epoch in range(3):
    total = 0.0
    for batch in train.loader(batch_size=16, shuffle=True, seed=epoch):
        confidence, depth_m = network(batch["image"].float() / 255).unbind(1)
        there = batch["confidence"]
        loss = confidence_loss(confidence, there)
        loss = loss + (there * (depth_m - batch["depth"]) ** 2).sum() / there.sum().clamp(min=1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        total += loss.item() * len(there)
    print(f"epoch {epoch + 1}: loss {total / len(train):.3f}")

with torch.inference_mode():
    batch = next(iter(test.loader(batch_size=len(test))))
    best = network(batch["image"].float() / 255)[:, 0].flatten(1).argmax(1)
print("cells with the highest confidence:", best[:8].tolist())
