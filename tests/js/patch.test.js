import assert from "node:assert/strict";
import { test } from "node:test";
import { counterparts, staying } from "../../src/gsplat_edu/viewer/web/patch.js";

// All orders of some values.
const orders = (values) =>
  values.length
    ? values.flatMap((one) => orders(values.filter((other) => other !== one)).map((rest) => [one, ...rest]))
    : [[]];

const rises = (values) => values.every((value, i) => !i || values[i - 1] < value);

// The size of the largest set of values, among them `pin`, that are in rising order: by trying all sets.
function mostThatStay(order, pin) {
  let most = 0;
  for (let set = 0; set < 1 << order.length; ++set) {
    const some = order.filter((_, i) => (set >> i) & 1);
    if (rises(some) && (pin < 0 || some.includes(pin))) most = Math.max(most, some.length);
  }
  return most;
}

test("a wanted child is the present one of its name, in their order", () => {
  assert.deepEqual(counterparts(["p", "p", "li a"], ["li a", "p", "ul", "p"]), [1, 3, 0]);
  assert.deepEqual(counterparts(["p", "p"], ["p"]), [0, -1]);
  assert.deepEqual(counterparts([], ["p"]), []);
});

test("an element is only itself", () => {
  const [one, other] = [{}, {}];
  assert.deepEqual(counterparts([other, "p"], [one, "p", other]), [2, 1]);
  assert.deepEqual(counterparts([one], [other]), [-1]);
});

test("as few children as possible move, in every order of six, with each pinned one and without", () => {
  for (const order of orders([0, 1, 2, 3, 4, 5])) {
    for (const pin of [-1, 0, 3, 5]) {
      const stay = staying(order, [pin]);
      assert.ok(rises(order.filter((at) => stay.has(at))), `${order}`);
      assert.equal(stay.size, mostThatStay(order, pin), `${order}, pinned ${pin}`);
      assert.ok(pin < 0 || stay.has(pin), `${order}, pinned ${pin}`);
    }
  }
});

test("new children move nobody", () => {
  assert.deepEqual([...staying([-1, 0, -1, 1, 2, -1])].sort(), [0, 1, 2]);
});

test("of two pinned children that change places, the first stays", () => {
  assert.deepEqual([...staying([1, 0], [0, 1])], [0]);
  assert.deepEqual([...staying([1, 0], [1, 0])], [1]);
  assert.deepEqual([...staying([2, 0, 1, 3], [1, 3])].sort(), [0, 1, 3]);
});

test("a pinned child that is gone pins nothing", () => {
  assert.deepEqual([...staying([1, 2], [0])].sort(), [1, 2]);
});
