// The planning environments drawn, with what the program will do next. A click changes the state.
//
// desk: { selected, select(thing), edit(state), announce(text) }, what the page lends to a board

// An arrow; `curve` lifts its middle.
function arrow(x1, y1, x2, y2, curve = 0) {
  const [midX, midY] = [(x1 + x2) / 2, (y1 + y2) / 2 - curve];
  const angle = Math.atan2(y2 - midY, x2 - midX);
  const barb = (turn) => `${x2 - 11 * Math.cos(angle + turn)} ${y2 - 11 * Math.sin(angle + turn)}`;
  return draw(
    "g",
    { class: "arrow", "aria-hidden": "true" },
    draw("path", { d: `M ${x1} ${y1} Q ${midX} ${midY} ${x2} ${y2}` }),
    draw("path", { d: `M ${barb(0.5)} L ${x2} ${y2} L ${barb(-0.5)}` })
  );
}

function board(width, height, label, ...parts) {
  const look = { viewBox: `0 0 ${width} ${height}`, class: "board", role: "group", "aria-label": label };
  return draw("svg", look, ...parts);
}

const BOARDS = {};

BOARDS["Hanoi-v0"] = {
  hint:
    "Change the state: click a peg to lift its top disc, then another peg to put it down. The program starts anew " +
    "from there.",

  words({ discs }) {
    const at = (peg) => discs.flatMap((where, disc) => (where === peg ? [disc + 1] : [])).join(" ") || "empty";
    return [0, 1, 2].map((peg) => `peg ${peg}: ${at(peg)}`).join("; ");
  },

  draw(frame, desk) {
    const { discs, source, target } = frame.state;
    const [floor, centres] = [188, [84, 240, 396]];
    const thickness = Math.min(22, 150 / Math.max(discs.length, 6));
    const tops = new Hanoi(frame.state).tops();
    const heights = [0, 0, 0];
    const pegs = centres.map((x, peg) => {
      const role = peg === target ? "target" : peg === source ? "source" : "";
      return draw(
        "g",
        { class: "peg", "data-key": `peg${peg}`, ...asButton(`Peg ${peg}`, () => this.press(frame, peg, desk)) },
        draw("rect", { x: x - 78, y: 4, width: 156, height: floor + 30, class: "zone" }),
        draw("rect", { x: x - 3.5, y: floor - 164, width: 7, height: 164, rx: 3.5, class: "wood" }),
        draw("text", { x, y: floor + 26, class: role === "target" ? "mark" : "label" }, `${peg} ${role}`.trim())
      );
    });
    const stack = discs
      .map((peg, disc) => ({ peg, disc }))
      .reverse()
      .map(({ peg, disc }) => {
        const half = 14 + (56 * (disc + 1)) / discs.length;
        const lifted = desk.selected === peg && tops[peg] === disc;
        heights[peg] += 1;
        const y = floor - heights[peg] * thickness - (lifted ? 12 : 0);
        const look = `disc ${disc % 2 ? "light" : "dark"}${lifted ? " lifted" : ""}`;
        const size = { width: 2 * half, height: thickness - 1.5, rx: 5 };
        return draw("rect", { x: centres[peg] - half, y, ...size, class: look });
      });
    const move = frame.final ? null : Hanoi.moves[frame.action];
    const top = (peg) => floor - heights[peg] * thickness - 8;
    return board(
      480,
      228,
      `Tower of Hanoi. ${this.words(frame.state)}`,
      draw("rect", { x: 8, y: floor, width: 464, height: 7, rx: 3.5, class: "wood" }),
      pegs,
      stack,
      move ? arrow(centres[move[0]], top(move[0]), centres[move[1]], top(move[1]), 46) : null
    );
  },

  press(frame, peg, desk) {
    const world = new Hanoi(frame.state);
    const { discs } = world.state;
    if (desk.selected === null) {
      if (discs.includes(peg)) desk.select(peg);
    } else if (desk.selected === peg) {
      desk.select(null);
    } else if (world.allows(desk.selected, peg)) {
      discs[world.tops()[desk.selected]] = peg;
      desk.edit(world.state);
    } else {
      desk.select(null);
      desk.announce("A larger disc may not lie on a smaller one.");
    }
  },
};

const PLATE_COLOURS = ["#b22234", "#d9682a", "#c99514", "#5d9436", "#278c82", "#2f6fb4", "#6250ad", "#a0468c"];

BOARDS["Stacking-v0"] = {
  hint:
    "Change the state: click a cell to put the gripper there. Click a plate, then an empty cell, to move the plate; " +
    "click it twice to put the gripper above it.",

  words({ plates, gripper, n_plates: total }) {
    const where = `gripper at row ${gripper[0]}, column ${gripper[1]}`;
    return `${counted(plates.length, "plate")} on the table, ${total - plates.length} on the stack, ${where}`;
  },

  draw(frame, desk) {
    const { plates, gripper, n_plates: total } = frame.state;
    const [cell, edge] = [58, 10];
    const centre = ([row, column]) => [edge + (column + 0.5) * cell, edge + (row + 0.5) * cell];
    const cells = Array.from({ length: 25 }, (_, index) => {
      const [row, column] = [Math.floor(index / 5), index % 5];
      return draw("rect", {
        x: edge + column * cell, y: edge + row * cell, width: cell, height: cell, class: "cell",
        "data-key": `cell${index}`,
        ...asButton(`Row ${row}, column ${column}`, () => this.press(frame, [row, column], desk)),
      });
    });
    const discs = plates.map((place, rank) => {
      const [size, [x, y]] = [plates.length - rank, centre(place)];
      return this.plate(x, y, 9 + (17 * size) / total, total - size, size, desk.selected === rank);
    });
    const side = edge + 5 * cell;
    const stack = Array.from({ length: total - plates.length }, (_, slot) => {
      const half = 14 + (44 * (total - slot)) / total;
      const y = side - 26 * (slot + 1) - 3;
      return draw(
        "g",
        {},
        draw("rect", { x: 400 - half, y, width: 2 * half, height: 24, rx: 7, fill: PLATE_COLOURS[slot] }),
        draw("text", { x: 400, y: y + 12, class: "on-plate" }, `${total - slot}`)
      );
    });
    const [x, y] = centre(gripper);
    const jaw = (sign) => `M ${x + sign * 17} ${y - 25} h ${sign * 8} v 50 h ${-sign * 8}`;
    return board(
      480, 328, `Table with plates. ${this.words(frame.state)}`,
      cells, discs,
      draw("path", { d: `${jaw(-1)} ${jaw(1)}`, class: "gripper" }),
      this.next(frame, x, y, cell),
      draw("rect", { x: 336, y: side - 2, width: 128, height: 6, rx: 3, class: "wood" }),
      stack,
      draw("text", { x: edge + 2.5 * cell, y: side + 20, class: "label" }, "table and gripper"),
      draw("text", { x: 400, y: side + 20, class: "label" }, "stack")
    );
  },

  plate(x, y, radius, colour, size, selected) {
    return draw(
      "g",
      { class: selected ? "plate lifted" : "plate" },
      draw("circle", { cx: x, cy: y, r: radius, fill: PLATE_COLOURS[colour] }),
      draw("circle", { cx: x, cy: y, r: 0.72 * radius, class: "rim" }),
      draw("text", { x, y, class: "on-plate" }, `${size}`)
    );
  },

  next(frame, x, y, cell) {
    if (frame.final) return null;
    if (frame.action === 4) return draw("circle", { cx: x, cy: y, r: 27, class: "pick" });
    const [down, right] = COMPASS[frame.action];
    return arrow(x + 14 * right, y + 14 * down, x + 0.72 * cell * right, y + 0.72 * cell * down);
  },

  press(frame, place, desk) {
    const { state } = new Stacking(frame.state);
    const here = state.plates.findIndex((plate) => plate[0] === place[0] && plate[1] === place[1]);
    if (desk.selected === null && here >= 0) {
      desk.select(here);
    } else if (desk.selected === null || desk.selected === here) {
      state.gripper = place;
      desk.edit(state);
    } else if (here < 0) {
      state.plates[desk.selected] = place;
      desk.edit(state);
    } else {
      desk.select(null);
      desk.announce("Each plate has a cell of its own.");
    }
  },
};

BOARDS["Hiking-v1"] = {
  hint:
    "Change the state: click a pathway cell to add or remove a star. Click the hiker, then a cell, to move the hiker.",
  seesWindow: false,

  words({ hiker, stars }) {
    const at = stars.map(([row, column]) => `row ${row} column ${column}`).join(", ");
    return `Hiker at row ${hiker[0]}, column ${hiker[1]}; ${counted(stars.length, "star")} left${at ? `: ${at}` : ""}`;
  },

  draw(frame, desk, past = []) {
    const { hiker, stars } = frame.state;
    const world = new Hiking(frame.state);
    const size = 46;
    const centre = ([row, column]) => [(column + 0.5) * size, (row + 0.5) * size];
    const ground = Array.from({ length: 80 }, (_, index) => {
      const [row, column] = [Math.floor(index / 10), index % 10];
      const place = { x: column * size, y: row * size, width: size, height: size };
      if (world.isPath(row, column)) {
        const press = asButton(`Row ${row}, column ${column}`, () => this.press(frame, [row, column], desk));
        return draw("rect", { ...place, class: "path", "data-key": `cell${index}`, ...press });
      }
      return draw("rect", { ...place, class: world.rows[row][column] === "~" ? "water" : "rock" });
    });
    const [x, y] = centre(hiker);
    const walked = past.slice(-40).map(({ state }) => centre(state.hiker).join(" "));
    const window = { x: x - 4.5 * size, y: y - 4.5 * size, width: 9 * size, height: 9 * size, rx: 6, class: "window" };
    const [down, right] = frame.final ? [0, 0] : COMPASS[frame.action];
    return board(
      460, 368, this.words(frame.state), ground,
      draw("polyline", { points: [...walked, `${x} ${y}`].join(" "), class: "trail" }),
      stars.map((star) => draw("polygon", { points: this.star(...centre(star), 15), class: "star" })),
      this.seesWindow ? draw("rect", window) : null,
      draw("circle", { cx: x, cy: y, r: 13, class: desk.selected === "hiker" ? "hiker lifted" : "hiker" }),
      frame.final ? null : arrow(x + 15 * right, y + 15 * down, x + 0.95 * size * right, y + 0.95 * size * down)
    );
  },

  star(x, y, radius) {
    return Array.from({ length: 10 }, (_, i) => {
      const [angle, reach] = [(i * Math.PI) / 5 - Math.PI / 2, i % 2 ? 0.42 * radius : radius];
      return `${x + reach * Math.cos(angle)} ${y + reach * Math.sin(angle)}`;
    }).join(" ");
  },

  press(frame, place, desk) {
    const world = new Hiking(frame.state);
    const { state } = world;
    const here = world.starAt(...place);
    const onHiker = state.hiker[0] === place[0] && state.hiker[1] === place[1];
    if (desk.selected === "hiker") {
      if (onHiker) return desk.select(null);
      state.hiker = place;
    } else if (onHiker) {
      return desk.select("hiker");
    }
    if (here >= 0) state.stars.splice(here, 1);
    else if (desk.selected !== "hiker") state.stars.push(place);
    if (state.stars.length === 0 || state.stars.length > 12) {
      desk.select(null);
      return desk.announce("There are 1 to 12 stars.");
    }
    state.n_stars = Math.max(state.n_stars, state.stars.length);
    return desk.edit(state);
  },
};

BOARDS["Hiking-v0"] = BOARDS["Hiking-v1"];
BOARDS["HikingEgo-v0"] = { ...BOARDS["Hiking-v1"], seesWindow: true };
