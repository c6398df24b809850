// A recorded Panda episode: the table from above and from the robot's side.

const OBJECT_COLOURS = ["#cf3a35", "#2f6fc4", "#3d9a46", "#c9a014", "#8456c2", "#dd7f2a", "#1e9fb0", "#d3649f"];

// Read the positions of an episode: for each frame the gripper, its fingers and the objects.
function readScene({ scene, steps }) {
  const grippers = unpack(scene.grippers);
  const objects = scene.objects ? unpack(scene.objects) : [];
  const n = scene.targets.length;
  const frames = Array.from({ length: steps + 1 }, (_, t) => ({
    gripper: Array.from(grippers.slice(4 * t, 4 * t + 3)),
    fingers: grippers[4 * t + 3],
    objects: scene.objects
      ? Array.from({ length: n }, (_, i) => Array.from(objects.slice(3 * (n * t + i), 3 * (n * t + i) + 3)))
      : [],
    finished: [...scene.finished[t]].map((mark) => mark === "1"),
  }));
  const points = [...scene.targets, ...frames.flatMap((frame) => [frame.gripper, ...frame.objects])];
  const reach = (axis, low, high) => {
    const values = points.map((point) => point[axis]);
    return [Math.min(low, ...values) - 0.05, Math.max(high, ...values) + 0.05];
  };
  const [x, y, z] = [reach(0, -0.1, 0.1), reach(1, -0.2, 0.2), [-0.04, reach(2, 0, 0.2)[1]]];
  return { frames, targets: scene.targets, x, y, z };
}

// Two views that share their horizontal axis, y: from above, and from the robot.
function drawScene(scene, t) {
  const [width, gap, label] = [480, 14, 18];
  const span = ([low, high]) => high - low;
  const scale = Math.min(width / span(scene.y), 400 / (span(scene.x) + span(scene.z)));
  const [topHeight, sideHeight] = [span(scene.x) * scale, span(scene.z) * scale];
  const middle = (scene.y[0] + scene.y[1]) / 2;
  const across = (point) => width / 2 - (point[1] - middle) * scale; // y grows to the left, as the robot sees it
  const top = label + topHeight + gap + label;
  const above = (point) => [across(point), label + (scene.x[1] - point[0]) * scale];
  const aside = (point) => [across(point), top + (scene.z[1] - point[2]) * scale];
  const now = scene.frames[t];
  const view = (place, y, height, name, floor) => [
    draw("text", { x: 0, y: y - 9, class: "label left" }, name),
    draw("rect", { x: 0.5, y, width: width - 1, height, rx: 6, class: "panel" }),
    floor === null ? null : draw("line", { x1: 1, x2: width - 1, y1: floor, y2: floor, class: "floor" }),
    trail(scene, t, place),
    scene.targets.map((target, i) => mark(place(target), i, now.finished[i], scale)),
    now.objects.map((object, i) => block(place(object), i, scale)),
    hand(place(now.gripper), now.fingers, scale),
  ];
  const left = now.finished.filter((done) => !done).length;
  return board(
    width, top + sideHeight + 1, `Robot scene. ${left} of ${scene.targets.length} unfinished`,
    view(above, label, topHeight, "from above", null),
    view(aside, top, sideHeight, "from the robot", top + scene.z[1] * scale)
  );
}

function trail(scene, t, place) {
  const line = (frames, look) => {
    const points = frames.map(({ gripper }) => place(gripper).map((value) => value.toFixed(1)).join(" "));
    return draw("polyline", { points: points.join(" "), class: look });
  };
  return [line(scene.frames, "trail faint"), line(scene.frames.slice(0, t + 1), "trail")];
}

function mark([x, y], index, finished, scale) {
  const colour = OBJECT_COLOURS[index];
  return draw(
    "g",
    { class: finished ? "target finished" : "target" },
    draw("circle", { cx: x, cy: y, r: 0.05 * scale, stroke: colour, fill: colour }),
    draw("text", { x, y, class: "label" }, finished ? "\u2713" : `${index + 1}`)
  );
}

function block([x, y], index, scale) {
  const size = 0.04 * scale;
  const place = { x: x - size / 2, y: y - size / 2, width: size, height: size, rx: 3 };
  return draw("rect", { ...place, fill: OBJECT_COLOURS[index], class: "object" });
}

function hand([x, y], fingers, scale) {
  const [half, long] = [Math.max(3, (fingers / 2) * scale), 9];
  const finger = (sign) => `M ${x + sign * half} ${y - long} V ${y + long}`;
  return draw("path", { d: `${finger(-1)} ${finger(1)} M ${x - half} ${y - long} H ${x + half}`, class: "gripper" });
}
