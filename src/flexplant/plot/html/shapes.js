// Mode shapes that move: each figure.shape holds nodes, edges and displacements as JSON.
document.querySelectorAll("figure.shape").forEach((figure) => {
  const data = JSON.parse(figure.querySelector("script").textContent);
  const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d");
  const select = figure.querySelector("select"), button = figure.querySelector("button");
  const amplitude = figure.querySelector("input");
  let turn = -0.6, tilt = 0.5, phase = Math.PI / 2, visible = true, last = 0;
  let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;

  const projected = (x, y, z) => {
    const across = x * Math.cos(turn) - y * Math.sin(turn);
    const depth = x * Math.sin(turn) + y * Math.cos(turn);
    return [across, -(z * Math.cos(tilt) + depth * Math.sin(tilt))];
  };
  const colour = (part) => {  // grey at rest, then blue to orange
    const stops = [[165, 172, 180], [31, 95, 153], [230, 126, 34]];
    const k = Math.min(part, 0.999) * 2, i = Math.floor(k), f = k - i;
    return `rgb(${stops[i].map((c, j) => Math.round(c + (stops[i + 1][j] - c) * f)).join(",")})`;
  };
  const draw = () => {
    const width = canvas.clientWidth, height = canvas.clientHeight, dots = window.devicePixelRatio;
    canvas.width = width * dots;
    canvas.height = height * dots;
    pen.setTransform(dots, 0, 0, dots, width * dots / 2, height * dots / 2);
    const size = 0.72 * Math.min(width, height * 1.3) / 1000, mode = data.modes[select.value];
    const factor = Math.sin(phase) * amplitude.value / 100, rest = [], moved = [], part = [];
    for (let i = 0; i < data.xyz.length; i += 3) {
      const at = data.xyz.slice(i, i + 3), by = mode.slice(i, i + 3);
      rest.push(projected(...at).map((c) => c * size));
      moved.push(projected(...at.map((c, j) => c + factor * by[j])).map((c) => c * size));
      part.push(Math.hypot(...by) / 1000);
    }
    const lines = (points, style) => {
      for (const [a, b] of data.edges) {
        pen.strokeStyle = style(a, b);
        pen.beginPath();
        pen.moveTo(...points[a]);
        pen.lineTo(...points[b]);
        pen.stroke();
      }
    };
    pen.lineWidth = 1;
    lines(rest, () => "#dfe4e9");
    pen.lineWidth = 1.6;
    lines(moved, (a, b) => colour((part[a] + part[b]) / 2));
    moved.forEach(([x, y], i) => {
      pen.fillStyle = colour(part[i]);
      pen.fillRect(x - 1.5, y - 1.5, 3, 3);
    });
  };
  const step = (time) => {
    if (playing && visible) {
      phase += Math.min(time - last, 100) * Math.PI / 1000;  // a turn in two seconds
      draw();
    }
    last = time;
    requestAnimationFrame(step);
  };
  const still = () => { phase = Math.PI / 2; draw(); };
  const label = () => { button.textContent = playing ? "pause" : "play"; };
  button.addEventListener("click", () => { playing = !playing; label(); if (!playing) still(); });
  for (const input of [select, amplitude]) input.addEventListener("input", draw);
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    turn += event.movementX / 150;
    tilt = Math.min(Math.max(tilt + event.movementY / 150, -1.5), 1.5);
    draw();
  });
  new IntersectionObserver((seen) => { visible = seen[0].isIntersecting; }).observe(canvas);
  window.addEventListener("beforeprint", still);
  window.addEventListener("resize", draw);
  label();
  draw();
  requestAnimationFrame(step);
});
