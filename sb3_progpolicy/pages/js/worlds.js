// The four planning environments: what is observed, what a step does and what it earns, as in progpolicy_envs.
// A state is plain data, the one that the Python environment's `state` returns; of Hiking the layout is rows of text.
const STEP_REWARD = -0.01;
const ILLEGAL_REWARD = -0.05;
const COMPASS = [
  [-1, 0],
  [0, 1],
  [1, 0],
  [0, -1],
]; // north, east, south, west

class Hanoi {
  constructor(state) {
    this.state = { ...state, discs: [...state.discs] };
  }

  static moves = [
    [0, 1],
    [0, 2],
    [1, 0],
    [1, 2],
    [2, 0],
    [2, 1],
  ];

  // The top disc of each peg, 0 the smallest; the number of discs for an empty peg.
  tops() {
    const { discs } = this.state;
    return [0, 1, 2].map((peg) => (discs.includes(peg) ? discs.indexOf(peg) : discs.length));
  }

  observe() {
    const { discs, source, target } = this.state;
    const tops = this.tops();
    return tops.flatMap((top, peg) => {
      const empty = top === discs.length;
      const shade = top + (empty && peg !== source && peg !== target ? 1 : 0);
      const rank = tops.reduce((sum, other) => sum + Math.sign(top - other), 0) / 2;
      return [rank, 2 * (shade % 2) - 1, empty ? 1 : 0];
    });
  }

  // Whether the top disc of one peg may be put onto another.
  allows(from, to) {
    const tops = this.tops();
    return tops[from] < tops[to];
  }

  step(action) {
    const [from, to] = Hanoi.moves[action];
    const legal = this.allows(from, to);
    if (legal) this.state.discs[this.tops()[from]] = to;
    const done = this.isSolved();
    return { reward: (legal ? STEP_REWARD : STEP_REWARD + ILLEGAL_REWARD) + (done ? 1 : 0), done, legal };
  }

  isSolved() {
    return this.state.discs.every((peg) => peg === this.state.target);
  }
}

class Stacking {
  constructor(state) {
    this.state = { ...state, plates: state.plates.map((plate) => [...plate]), gripper: [...state.gripper] };
  }

  observe() {
    const { n_plates: total, plates, gripper } = this.state;
    const table = new Array(25).fill(0);
    plates.forEach(([row, column], rank) => (table[5 * row + column] = 8 ** -rank));
    const onStack = (slot) => (slot < total - plates.length ? Math.fround((total - slot) / total) : 0);
    const stack = Array.from({ length: 8 }, (_, slot) => onStack(slot));
    return [...table, ...stack, ...gripper.map((place) => (2 * place) / 4 - 1)];
  }

  step(action) {
    const { plates, gripper } = this.state;
    let earned = ILLEGAL_REWARD;
    if (action === 4) {
      if (plates.length && plates[0][0] === gripper[0] && plates[0][1] === gripper[1]) {
        plates.shift();
        earned = 1;
      }
    } else {
      const [row, column] = gripper.map((place, axis) => place + COMPASS[action][axis]);
      if (row >= 0 && row < 5 && column >= 0 && column < 5) {
        this.state.gripper = [row, column];
        earned = 0;
      }
    }
    return { reward: STEP_REWARD + earned, done: this.isSolved(), legal: earned !== ILLEGAL_REWARD };
  }

  isSolved() {
    return this.state.plates.length === 0;
  }
}

class Hiking {
  constructor(state) {
    this.state = { ...state, hiker: [...state.hiker], stars: state.stars.map((star) => [...star]) };
    this.rows = state.layout.split("\n");
  }

  static nRows = 8;
  static nColumns = 10;

  isPath(row, column) {
    return ".H*".includes((this.rows[row] || "")[column] || "#");
  }

  starAt(row, column) {
    return this.state.stars.findIndex((star) => star[0] === row && star[1] === column);
  }

  // The whole map.
  observe() {
    const { hiker } = this.state;
    return this.cells(0, 0, Hiking.nRows, Hiking.nColumns).map(([row, column]) => {
      if (row === hiker[0] && column === hiker[1]) return 1;
      return this.number(row, column, this.share());
    });
  }

  // The number of a star: all that are left share a quarter.
  share() {
    return Math.fround(0.25 / Math.max(1, this.state.stars.length));
  }

  number(row, column, star) {
    if (!this.isPath(row, column)) return -1;
    return this.starAt(row, column) >= 0 ? star : 0;
  }

  cells(top, left, height, width) {
    return Array.from({ length: height * width }, (_, i) => [top + Math.floor(i / width), left + (i % width)]);
  }

  step(action) {
    const { hiker, stars } = this.state;
    const ahead = hiker.map((place, axis) => place + COMPASS[action][axis]);
    const legal = this.isPath(...ahead);
    let reward = legal ? STEP_REWARD : STEP_REWARD + ILLEGAL_REWARD;
    if (legal) this.state.hiker = ahead;
    const found = this.starAt(...this.state.hiker);
    if (found >= 0) {
      stars.splice(found, 1);
      reward += 1;
    }
    return { reward, done: this.isSolved(), legal };
  }

  isSolved() {
    return this.state.stars.length === 0;
  }
}

class HikingV0 extends Hiking {
  share() {
    return 0.0625;
  }
}

class HikingEgo extends Hiking {
  static reach = 4;

  // The cells around the hiker, without the hiker's own.
  observe() {
    const [row, column] = this.state.hiker;
    const { reach } = HikingEgo;
    const window = this.cells(row - reach, column - reach, 2 * reach + 1, 2 * reach + 1);
    window.splice((window.length - 1) / 2, 1);
    return window.map(([down, right]) => this.number(down, right, 1));
  }
}

const WORLDS = {
  "Hanoi-v0": Hanoi,
  "Stacking-v0": Stacking,
  "Hiking-v1": Hiking,
  "Hiking-v0": HikingV0,
  "HikingEgo-v0": HikingEgo,
};
if (typeof module !== "undefined" && module.exports) module.exports = { WORLDS };
