"use strict";
(() => {
  const figure = document.currentScript.parentElement;
  const data = JSON.parse(figure.querySelector('script[type="application/json"]').textContent);
  const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d");
  const button = figure.querySelector("button"), slider = figure.querySelector("input");
  const clock = figure.querySelector("output");
  const frames = data.times.length, size = 3 * data.bodies;
  const { solids = [], poses = [], paths = [], forces = [], texts = [] } = data;
  let turn = -2.2, lift = 0.45, zoom = 1, frame = 0, playing = false, started = 0, dragged = null;
  slider.max = frames - 1;

  // The legend: a box for each arm that shows or hides it, and a note where its prediction has ended.
  const boxes = [], notes = [];
  data.films.forEach((film) => {
    const name = document.createElement("label"), box = document.createElement("input");
    const note = document.createElement("span");
    box.type = "checkbox"; box.checked = true; box.onchange = () => draw();
    name.style.color = film.colour;
    name.append(box, " " + film.label, note);
    figure.querySelector(".films").append(name, " ");
    boxes.push(box); notes.push(note);
  });

  // Orthographic view from a direction (turn, lift), in metres about the middle of the arm.
  const first = data.films[0].points;
  let reach = 0.3;
  for (let i = 0; i < first.length; i += 3) {
    reach = Math.max(reach, Math.hypot(first[i] - first[0], first[i + 1] - first[1], first[i + 2] - first[2]));
  }
  const centre = [first[0], first[1], first[2] + 0.35 * reach];
  const scale = 0.42 * canvas.height / reach * 1.35;
  const view = (x, y, z) => {
    const dx = x - centre[0], dy = y - centre[1], dz = z - centre[2];
    const across = -Math.sin(turn) * dx + Math.cos(turn) * dy;
    const ahead = Math.cos(turn) * dx + Math.sin(turn) * dy;
    const up = Math.cos(lift) * dz - Math.sin(lift) * ahead;
    return [canvas.width / 2 + zoom * scale * across, canvas.height / 2 - zoom * scale * up];
  };
  const line = (points, colour, width) => {
    pen.strokeStyle = colour; pen.lineWidth = width; pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.stroke();
  };
  const triples = (flat) => Array.from({ length: flat.length / 3 }, (_, i) => flat.slice(3 * i, 3 * i + 3));
  // An orthographic picture of a convex solid is the convex hull of the pictures of its corners.
  const hull = (points) => {
    points.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    const half = (list) => list.reduce((out, p) => {
      while (out.length > 1) {
        const [a, b] = out.slice(-2);
        if ((b[0] - a[0]) * (p[1] - a[1]) > (b[1] - a[1]) * (p[0] - a[0])) break;
        out.pop();
      }
      return [...out, p];
    }, []);
    return [...half(points).slice(0, -1), ...half([...points].reverse()).slice(0, -1)];
  };
  // A solid moves with the pose of its link: nine entries of a rotation, then a position.
  const placed = (solid) => {
    const points = triples(solid.points);
    if (solid.link === null) return points;
    const [a, b, c, d, e, f, g, h, i, x, y, z] = poses[frame][solid.link];
    return points.map(([u, v, w]) =>
      [a * u + b * v + c * w + x, d * u + e * v + f * w + y, g * u + h * v + i * w + z]);
  };
  const depth = (points) => points.reduce((sum, [x, y, z]) => sum + Math.sin(lift) * z
    + Math.cos(lift) * (Math.cos(turn) * x + Math.sin(turn) * y), 0) / points.length;
  const drawSolids = () => {
    const shown = solids.map((solid) => ({ ...solid, at: placed(solid) }));
    shown.sort((a, b) => depth(a.at) - depth(b.at)).forEach((solid) => {
      const outline = hull(solid.at.map((p) => view(...p)));
      line([...outline, outline[0]], solid.colour, 1);
      pen.globalAlpha = solid.opacity; pen.fillStyle = solid.colour; pen.fill(); pen.globalAlpha = 1;
    });
  };
  const drawForce = (force) => {
    if (!force.start[frame]) return;
    const [from, to] = [view(...force.start[frame]), view(...force.tip[frame])];
    line(force.bar[frame].map((p) => view(...p)), "#f5967888", 10);
    line([from, to], "#c81e2d", 4);
    const along = Math.atan2(to[1] - from[1], to[0] - from[0]);
    const side = (angle) => [to[0] - 12 * Math.cos(along + angle), to[1] - 12 * Math.sin(along + angle)];
    line([side(0.45), to, side(-0.45)], "#c81e2d", 4);
  };
  const draw = () => {
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.lineJoin = pen.lineCap = "round";
    for (let k = -4; k <= 4; k++) {
      const s = 0.2 * k, z = first[size - 1], x = first[0], y = first[1];
      line([view(x - 0.8, y + s, z), view(x + 0.8, y + s, z)], "#e3e3e3", 1);
      line([view(x + s, y - 0.8, z), view(x + s, y + 0.8, z)], "#e3e3e3", 1);
    }
    drawSolids();
    paths.forEach((path) => line(triples(path.points).map((p) => view(...p)), path.colour, path.width));
    data.films.forEach((film, index) => {
      const shown = Math.min(frame, film.points.length / size - 1);
      notes[index].textContent = shown < frame ? " (diverged)" : "";
      if (!boxes[index].checked) return;
      const at = (f, b) => view(...film.points.slice(f * size + 3 * b, f * size + 3 * b + 3));
      const trail = [];
      for (let f = Math.max(0, shown - 60); f <= shown; f++) trail.push(at(f, data.bodies - 1));
      const arm = Array.from({ length: data.bodies }, (_, b) => at(shown, b));
      pen.globalAlpha = shown < frame ? 0.25 : 1;
      line(trail, film.colour, 1.5);
      pen.setLineDash(film.dash);
      line(arm, film.colour, index ? 3 : 7);
      pen.setLineDash([]);
      pen.fillStyle = film.colour;
      arm.forEach(([x, y]) => { pen.beginPath(); pen.arc(x, y, index ? 3 : 5, 0, 7); pen.fill(); });
      pen.globalAlpha = 1;
    });
    forces.forEach(drawForce);
    slider.value = frame;
    clock.textContent = [data.times[frame].toFixed(2) + " s", ...(texts[frame] || [])].join("   ");
  };
  const tick = (now) => {
    if (!playing) return;
    const t = (now - started) / 1000;
    while (frame < frames - 1 && data.times[frame + 1] <= t) frame++;
    if (frame === frames - 1) stop();
    draw();
    requestAnimationFrame(tick);
  };
  const stop = () => { playing = false; button.textContent = "Play"; };
  button.onclick = () => {
    if (playing) return stop();
    if (frame === frames - 1) frame = 0;
    playing = true; button.textContent = "Pause";
    started = performance.now() - 1000 * data.times[frame];
    requestAnimationFrame(tick);
  };
  slider.oninput = () => { stop(); frame = Number(slider.value); draw(); };
  canvas.onpointerdown = (e) => { dragged = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointerup = () => { dragged = null; };
  canvas.onpointermove = (e) => {
    if (!dragged) return;
    turn -= 0.008 * (e.clientX - dragged[0]);
    lift = Math.max(-0.2, Math.min(1.5, lift + 0.008 * (e.clientY - dragged[1])));
    dragged = [e.clientX, e.clientY];
    draw();
  };
  canvas.onwheel = (e) => {
    if (!e.ctrlKey) return;  // without it the wheel scrolls the page
    e.preventDefault();
    zoom *= Math.exp(-0.002 * e.deltaY);
    draw();
  };
  draw();
})();
