// Pictures that can be zoomed, dragged and read: each figure.picture holds one SVG.
"use strict";
document.querySelectorAll("figure.picture").forEach((figure) => {
  const svg = figure.querySelector("svg"), canvas = figure.querySelector(".canvas");
  const output = figure.querySelector("output"), panels = JSON.parse(figure.dataset.panels);
  const whole = svg.getAttribute("viewBox").split(/[ ,]+/).map(Number);
  let view = whole.slice();
  const pointers = new Map();

  const show = () => {
    svg.setAttribute("viewBox", view.map((v) => v.toFixed(3)).join(" "));
    figure.classList.toggle("zoomed", view[2] < whole[2] * 0.999);
  };
  const at = (event) => {
    const matrix = svg.getScreenCTM().inverse();
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    return [point.x, point.y];
  };
  const zoom = (factor, [x, y]) => {
    const width = Math.min(Math.max(view[2] / factor, whole[2] / 60), whole[2]);
    const ratio = width / view[2];
    view = [x - (x - view[0]) * ratio, y - (y - view[1]) * ratio, width, view[3] * ratio];
    keep();
  };
  const keep = () => {
    for (const i of [0, 1]) {
      view[i] = Math.min(Math.max(view[i], whole[i]), whole[i] + whole[i + 2] - view[i + 2]);
    }
    show();
  };
  const middle = () => [view[0] + view[2] / 2, view[1] + view[3] / 2];
  const actions = {
    in: () => zoom(1.6, middle()),
    out: () => zoom(1 / 1.6, middle()),
    reset: () => { view = whole.slice(); show(); },
    large: () => figure.classList.toggle("large"),
  };
  figure.querySelectorAll("button").forEach((button) => {
    button.addEventListener("click", () => actions[button.dataset.do]());
  });
  figure.addEventListener("keydown", (event) => {
    if (event.key === "Escape") figure.classList.remove("large");
  });
  // the wheel scrolls the page, unless the picture is large or Ctrl is held
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !figure.classList.contains("large")) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 300), at(event));
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => zoom(2.5, at(event)));

  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (figure.classList.contains("zoomed")) canvas.setPointerCapture(event.pointerId);
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
    canvas.addEventListener(end, (event) => {
      pointers.delete(event.pointerId);
      if (end === "pointerleave") output.textContent = "";
    });
  }
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener("pointermove", (event) => {
    read(at(event));
    const old = pointers.get(event.pointerId);
    if (!old) return;
    const before = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (before) return zoom(spread() / before, at(event));
    const scale = svg.getScreenCTM().a;
    view[0] -= (event.clientX - old[0]) / scale;
    view[1] -= (event.clientY - old[1]) / scale;
    keep();
  });
  // coordinates under the cursor, in the units of the axes
  const value = (scale, part) => {
    if (!scale) return "";
    const [low, high, logarithmic, label] = scale;
    const found = logarithmic ? low * Math.pow(high / low, part) : low + (high - low) * part;
    return `${label ? label + ": " : ""}${Number(found.toPrecision(4))}`;
  };
  const read = ([x, y]) => {
    const panel = panels.find((p) => x >= p.box[0] && x <= p.box[2] && y >= p.box[1] && y <= p.box[3]);
    output.textContent = !panel ? "" : [
      value(panel.x, (x - panel.box[0]) / (panel.box[2] - panel.box[0])),
      value(panel.y, (panel.box[3] - y) / (panel.box[3] - panel.box[1])),
    ].filter(Boolean).join(", ");
  };
});
