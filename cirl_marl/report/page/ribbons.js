// Geometry of a flow diagram: along is the way of the flow, across is the other; a standing diagram exchanges the two.

export const HEAD = 7;
const LYING = { least: 84, most: 158, few: 4, far: 300, box: 0.32, margin: 10 };
const STANDING = { gap: 46, line: 12.5, margin: 16 };
const APART = 2;

/** The measures of a sketch that lies or stands in a given breadth of the page. */
export function frameOf(sketch, way, room) {
  const plan = sketch.ways[way];
  const layers = 1 + Math.max(0, ...plan.boxes.map(([layer]) => layer));
  const lying = way === "lying";
  const lines = Math.max(1, ...plan.labels.map((label) => label.length));
  const pitch = lying
    ? Math.min(layers > LYING.few ? LYING.most : LYING.far, Math.max(LYING.least, (room - 2 * LYING.margin) / layers))
    : STANDING.gap + STANDING.line * (lines + 1) + 10;
  const box = lying ? Math.min(44, LYING.box * pitch) : pitch - STANDING.gap;
  const margin = lying ? LYING.margin : STANDING.margin;
  const along = layers * pitch + 2 * margin;
  const across = plan.breadth + 2 * margin;
  const shift = lying ? sketch.caption / 2 : 0;
  const boxes = plan.boxes.map(([layer, middle, breadth]) => {
    const centre = margin + (layer + 0.5) * pitch;
    const at = margin + middle + shift;
    return { layer, begin: centre - box / 2, end: centre + box / 2, centre, at, breadth };
  });
  const courses = plan.courses.map((course, k) => {
    const { donor, recipient } = sketch.ribbons[k];
    const [low, high] = course.back ? [recipient, donor] : [donor, recipient];
    if (course.side) return { low, high, side: course.side, lane: margin + course.lane };
    const first = boxes[low].layer + 1;
    const via = course.via.map((at, i) => ({ at: margin + at, centre: margin + (first + i + 0.5) * pitch }));
    return { low, high, side: 0, via, back: course.back };
  });
  const point = lying ? (a, c) => `${a.toFixed(1)} ${c.toFixed(1)}` : (a, c) => `${c.toFixed(1)} ${a.toFixed(1)}`;
  const size = lying ? [along, across] : [across, along];
  return { lying, labels: plan.labels, pitch, box, boxes, courses, point, size, scale: plan.scale, gap: pitch - box };
}

/** Where every ribbon meets its boxes, with its width, when so much flows in each: `from` is at the end of the box of
 * the lower layer (of a loop, of the one that gives), `to` at the beginning of the other. */
export function endsOf(sketch, frame, flows) {
  const ends = flows.map((flow) => ({ width: Math.max(Math.abs(flow || 0) * frame.scale, flow ? 0.8 : 0.4) }));
  for (const [side, other, place, reach] of [
    ["low", "high", "from", "out"],
    ["high", "low", "to", "into"],
  ]) {
    const ports = frame.boxes.map(() => []);
    frame.courses.forEach((course, k) => ports[course[side]].push(k));
    const key = (k) => {
      const course = frame.courses[k];
      if (course.side) return course.side * 1e9 - course.lane;
      const near = side === "low" ? course.via[0] : course.via.at(-1);
      return near ? near.at : frame.boxes[course[other]].at;
    };
    ports.forEach((members, b) => {
      members.sort((one, two) => key(one) - key(two));
      const total = members.reduce((sum, k) => sum + ends[k].width, 0);
      let at = frame.boxes[b].at - total / 2;
      for (const k of members) {
        ends[k][place] = at + ends[k].width / 2;
        at += ends[k].width;
      }
      for (const turn of [-1, 1]) {
        const loops = members.filter((k) => frame.courses[k].side === turn);
        if (turn > 0) loops.reverse();
        let far = 4;
        for (const k of loops) {
          ends[k][reach] = Math.max(far + ends[k].width / 2, 9);
          far = ends[k][reach] + ends[k].width / 2 + APART;
        }
      }
    });
  }
  return ends;
}

/** The middle line of a ribbon, from the box that gives to before its head, as the data of a path. */
export function lineOf(frame, k, end) {
  const { point, courses } = frame;
  const course = courses[k];
  const start = frame.boxes[course.low].end + (course.back ? HEAD : 0);
  const stop = frame.boxes[course.high].begin - (course.back ? 0 : HEAD);
  if (course.side) return loopOf(point, course, end, start, stop);
  const knots = [[start, end.from], ...course.via.map(({ centre, at }) => [centre, at]), [stop, end.to]];
  const slopes = knots.map((knot, i) => (i && i < knots.length - 1 ? slopeAt(knots[i - 1], knot, knots[i + 1]) : 0));
  let path = `M${point(...knots[0])}`;
  for (let i = 1; i < knots.length; i += 1) {
    const [[a, c], [b, d]] = [knots[i - 1], knots[i]];
    const reach = (b - a) / (knots.length > 2 ? 3 : 2);
    path += `C${point(a + reach, c + reach * slopes[i - 1])} ${point(b - reach, d - reach * slopes[i])} ${point(b, d)}`;
  }
  return path;
}

/** The slope of a smooth curve at its middle knot, level where it turns. */
function slopeAt([a, c], [b, d], [e, f]) {
  const [before, after] = [(d - c) / (b - a), (f - d) / (e - b)];
  return before * after > 0 ? (2 * before * after) / (before + after) : 0;
}

function loopOf(point, course, end, start, stop) {
  const { lane, side } = course;
  const corner = (at, reach) => Math.min(reach, Math.max(end.width / 2 + 2, 7), Math.abs(lane - at) / 2);
  const [one, two] = [corner(end.from, end.out), corner(end.to, end.into)];
  const [out, back] = [start + end.out, stop - end.into];
  return [
    `M${point(start, end.from)}`,
    `L${point(out - one, end.from)}`,
    `Q${point(out, end.from)} ${point(out, end.from + side * one)}`,
    `L${point(out, lane - side * one)}`,
    `Q${point(out, lane)} ${point(out - one, lane)}`,
    `L${point(back + two, lane)}`,
    `Q${point(back, lane)} ${point(back, lane - side * two)}`,
    `L${point(back, end.to + side * two)}`,
    `Q${point(back, end.to)} ${point(back + two, end.to)}`,
    `L${point(stop, end.to)}`,
  ].join("");
}

/** The head of a ribbon where it arrives. */
export function headOf(frame, k, end) {
  const { low, high, back } = frame.courses[k];
  const [tip, at, foot] = back
    ? [frame.boxes[low].end, end.from, frame.boxes[low].end + HEAD]
    : [frame.boxes[high].begin, end.to, frame.boxes[high].begin - HEAD];
  const half = end.width / 2 + Math.min(3, 1 + end.width / 4);
  const corners = [[foot, at - half], [tip, at], [foot, at + half]];
  return corners.map(([a, c]) => frame.point(a, c).replace(" ", ",")).join(" ");
}

/** Where the label of a ribbon goes: just behind the box of the lower layer, or on the lane of a loop. */
export function labelAt(frame, k, end) {
  const course = frame.courses[k];
  const begin = frame.boxes[course.low].end;
  if (course.side) return [(begin + frame.boxes[course.high].begin) / 2, course.lane];
  const next = course.via.length ? course.via[0].at : end.to;
  return [begin + (frame.gap - HEAD) / 2, (end.from + next) / 2];
}
