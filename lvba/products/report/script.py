"""The page's script: what two pictures a slider compares. The sliders themselves are plain range inputs."""

SCRIPT = """
for (const box of document.querySelectorAll('.compare')) {
  const range = box.querySelector('input[type=range]');
  const stage = box.querySelector('.stage');
  const pictures = Object.fromEntries(
    [...stage.querySelectorAll('img')].map(img => [img.dataset.name, img]));
  const move = () => stage.style.setProperty('--at', range.value + '%');
  const show = pair => {
    const [left, right] = pair.split('|');
    for (const [name, img] of Object.entries(pictures)) {
      img.hidden = name !== left && name !== right;
      img.classList.toggle('top', name === right);
    }
    stage.querySelector('.left').textContent = pictures[left].alt;
    stage.querySelector('.right').textContent = pictures[right].alt;
  };
  range.addEventListener('input', move);
  for (const choice of box.querySelectorAll('input[type=radio]')) {
    choice.addEventListener('change', () => show(choice.value));
    if (choice.checked) show(choice.value);
  }
  move();
}
"""
