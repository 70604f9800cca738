begin_version
3
end_version
begin_metric
1
end_metric
11
begin_variable
var0
-1
3
Atom at(truck3, airport3)
Atom at(truck3, place3-1)
Atom at(truck3, place3-2)
end_variable
begin_variable
var1
-1
3
Atom at(truck2, airport2)
Atom at(truck2, place2-1)
Atom at(truck2, place2-2)
end_variable
begin_variable
var2
-1
3
Atom at(truck1, airport1)
Atom at(truck1, place1-1)
Atom at(truck1, place1-2)
end_variable
begin_variable
var3
-1
3
Atom at(plane2, airport1)
Atom at(plane2, airport2)
Atom at(plane2, airport3)
end_variable
begin_variable
var4
-1
3
Atom at(plane1, airport1)
Atom at(plane1, airport2)
Atom at(plane1, airport3)
end_variable
begin_variable
var5
-1
14
Atom at(package6, airport1)
Atom at(package6, airport2)
Atom at(package6, airport3)
Atom at(package6, place1-1)
Atom at(package6, place1-2)
Atom at(package6, place2-1)
Atom at(package6, place2-2)
Atom at(package6, place3-1)
Atom at(package6, place3-2)
Atom in(package6, plane1)
Atom in(package6, plane2)
Atom in(package6, truck1)
Atom in(package6, truck2)
Atom in(package6, truck3)
end_variable
begin_variable
var6
-1
14
Atom at(package5, airport1)
Atom at(package5, airport2)
Atom at(package5, airport3)
Atom at(package5, place1-1)
Atom at(package5, place1-2)
Atom at(package5, place2-1)
Atom at(package5, place2-2)
Atom at(package5, place3-1)
Atom at(package5, place3-2)
Atom in(package5, plane1)
Atom in(package5, plane2)
Atom in(package5, truck1)
Atom in(package5, truck2)
Atom in(package5, truck3)
end_variable
begin_variable
var7
-1
14
Atom at(package4, airport1)
Atom at(package4, airport2)
Atom at(package4, airport3)
Atom at(package4, place1-1)
Atom at(package4, place1-2)
Atom at(package4, place2-1)
Atom at(package4, place2-2)
Atom at(package4, place3-1)
Atom at(package4, place3-2)
Atom in(package4, plane1)
Atom in(package4, plane2)
Atom in(package4, truck1)
Atom in(package4, truck2)
Atom in(package4, truck3)
end_variable
begin_variable
var8
-1
14
Atom at(package3, airport1)
Atom at(package3, airport2)
Atom at(package3, airport3)
Atom at(package3, place1-1)
Atom at(package3, place1-2)
Atom at(package3, place2-1)
Atom at(package3, place2-2)
Atom at(package3, place3-1)
Atom at(package3, place3-2)
Atom in(package3, plane1)
Atom in(package3, plane2)
Atom in(package3, truck1)
Atom in(package3, truck2)
Atom in(package3, truck3)
end_variable
begin_variable
var9
-1
14
Atom at(package2, airport1)
Atom at(package2, airport2)
Atom at(package2, airport3)
Atom at(package2, place1-1)
Atom at(package2, place1-2)
Atom at(package2, place2-1)
Atom at(package2, place2-2)
Atom at(package2, place3-1)
Atom at(package2, place3-2)
Atom in(package2, plane1)
Atom in(package2, plane2)
Atom in(package2, truck1)
Atom in(package2, truck2)
Atom in(package2, truck3)
end_variable
begin_variable
var10
-1
14
Atom at(package1, airport1)
Atom at(package1, airport2)
Atom at(package1, airport3)
Atom at(package1, place1-1)
Atom at(package1, place1-2)
Atom at(package1, place2-1)
Atom at(package1, place2-2)
Atom at(package1, place3-1)
Atom at(package1, place3-2)
Atom in(package1, plane1)
Atom in(package1, plane2)
Atom in(package1, truck1)
Atom in(package1, truck2)
Atom in(package1, truck3)
end_variable
0
begin_state
0
0
0
0
0
8
6
4
7
5
3
end_state
begin_goal
6
5 4
6 8
7 6
8 3
9 7
10 5
end_goal
210
begin_operator
drive truck1 airport1 place1-1 city1
0
1
0 2 0 1
2
end_operator
begin_operator
drive truck1 airport1 place1-2 city1
0
1
0 2 0 2
2
end_operator
begin_operator
drive truck1 place1-1 airport1 city1
0
1
0 2 1 0
2
end_operator
begin_operator
drive truck1 place1-1 place1-2 city1
0
1
0 2 1 2
2
end_operator
begin_operator
drive truck1 place1-2 airport1 city1
0
1
0 2 2 0
2
end_operator
begin_operator
drive truck1 place1-2 place1-1 city1
0
1
0 2 2 1
2
end_operator
begin_operator
drive truck2 airport2 place2-1 city2
0
1
0 1 0 1
2
end_operator
begin_operator
drive truck2 airport2 place2-2 city2
0
1
0 1 0 2
2
end_operator
begin_operator
drive truck2 place2-1 airport2 city2
0
1
0 1 1 0
2
end_operator
begin_operator
drive truck2 place2-1 place2-2 city2
0
1
0 1 1 2
2
end_operator
begin_operator
drive truck2 place2-2 airport2 city2
0
1
0 1 2 0
2
end_operator
begin_operator
drive truck2 place2-2 place2-1 city2
0
1
0 1 2 1
2
end_operator
begin_operator
drive truck3 airport3 place3-1 city3
0
1
0 0 0 1
2
end_operator
begin_operator
drive truck3 airport3 place3-2 city3
0
1
0 0 0 2
2
end_operator
begin_operator
drive truck3 place3-1 airport3 city3
0
1
0 0 1 0
2
end_operator
begin_operator
drive truck3 place3-1 place3-2 city3
0
1
0 0 1 2
2
end_operator
begin_operator
drive truck3 place3-2 airport3 city3
0
1
0 0 2 0
2
end_operator
begin_operator
drive truck3 place3-2 place3-1 city3
0
1
0 0 2 1
2
end_operator
begin_operator
fly plane1 airport1 airport2
0
1
0 4 0 1
5
end_operator
begin_operator
fly plane1 airport1 airport3
0
1
0 4 0 2
5
end_operator
begin_operator
fly plane1 airport2 airport1
0
1
0 4 1 0
5
end_operator
begin_operator
fly plane1 airport2 airport3
0
1
0 4 1 2
5
end_operator
begin_operator
fly plane1 airport3 airport1
0
1
0 4 2 0
5
end_operator
begin_operator
fly plane1 airport3 airport2
0
1
0 4 2 1
5
end_operator
begin_operator
fly plane2 airport1 airport2
0
1
0 3 0 1
5
end_operator
begin_operator
fly plane2 airport1 airport3
0
1
0 3 0 2
5
end_operator
begin_operator
fly plane2 airport2 airport1
0
1
0 3 1 0
5
end_operator
begin_operator
fly plane2 airport2 airport3
0
1
0 3 1 2
5
end_operator
begin_operator
fly plane2 airport3 airport1
0
1
0 3 2 0
5
end_operator
begin_operator
fly plane2 airport3 airport2
0
1
0 3 2 1
5
end_operator
begin_operator
load package1 plane1 airport1
1
4 0
1
0 10 0 9
1
end_operator
begin_operator
load package1 plane1 airport2
1
4 1
1
0 10 1 9
1
end_operator
begin_operator
load package1 plane1 airport3
1
4 2
1
0 10 2 9
1
end_operator
begin_operator
load package1 plane2 airport1
1
3 0
1
0 10 0 10
1
end_operator
begin_operator
load package1 plane2 airport2
1
3 1
1
0 10 1 10
1
end_operator
begin_operator
load package1 plane2 airport3
1
3 2
1
0 10 2 10
1
end_operator
begin_operator
load package1 truck1 airport1
1
2 0
1
0 10 0 11
1
end_operator
begin_operator
load package1 truck1 place1-1
1
2 1
1
0 10 3 11
1
end_operator
begin_operator
load package1 truck1 place1-2
1
2 2
1
0 10 4 11
1
end_operator
begin_operator
load package1 truck2 airport2
1
1 0
1
0 10 1 12
1
end_operator
begin_operator
load package1 truck2 place2-1
1
1 1
1
0 10 5 12
1
end_operator
begin_operator
load package1 truck2 place2-2
1
1 2
1
0 10 6 12
1
end_operator
begin_operator
load package1 truck3 airport3
1
0 0
1
0 10 2 13
1
end_operator
begin_operator
load package1 truck3 place3-1
1
0 1
1
0 10 7 13
1
end_operator
begin_operator
load package1 truck3 place3-2
1
0 2
1
0 10 8 13
1
end_operator
begin_operator
load package2 plane1 airport1
1
4 0
1
0 9 0 9
1
end_operator
begin_operator
load package2 plane1 airport2
1
4 1
1
0 9 1 9
1
end_operator
begin_operator
load package2 plane1 airport3
1
4 2
1
0 9 2 9
1
end_operator
begin_operator
load package2 plane2 airport1
1
3 0
1
0 9 0 10
1
end_operator
begin_operator
load package2 plane2 airport2
1
3 1
1
0 9 1 10
1
end_operator
begin_operator
load package2 plane2 airport3
1
3 2
1
0 9 2 10
1
end_operator
begin_operator
load package2 truck1 airport1
1
2 0
1
0 9 0 11
1
end_operator
begin_operator
load package2 truck1 place1-1
1
2 1
1
0 9 3 11
1
end_operator
begin_operator
load package2 truck1 place1-2
1
2 2
1
0 9 4 11
1
end_operator
begin_operator
load package2 truck2 airport2
1
1 0
1
0 9 1 12
1
end_operator
begin_operator
load package2 truck2 place2-1
1
1 1
1
0 9 5 12
1
end_operator
begin_operator
load package2 truck2 place2-2
1
1 2
1
0 9 6 12
1
end_operator
begin_operator
load package2 truck3 airport3
1
0 0
1
0 9 2 13
1
end_operator
begin_operator
load package2 truck3 place3-1
1
0 1
1
0 9 7 13
1
end_operator
begin_operator
load package2 truck3 place3-2
1
0 2
1
0 9 8 13
1
end_operator
begin_operator
load package3 plane1 airport1
1
4 0
1
0 8 0 9
1
end_operator
begin_operator
load package3 plane1 airport2
1
4 1
1
0 8 1 9
1
end_operator
begin_operator
load package3 plane1 airport3
1
4 2
1
0 8 2 9
1
end_operator
begin_operator
load package3 plane2 airport1
1
3 0
1
0 8 0 10
1
end_operator
begin_operator
load package3 plane2 airport2
1
3 1
1
0 8 1 10
1
end_operator
begin_operator
load package3 plane2 airport3
1
3 2
1
0 8 2 10
1
end_operator
begin_operator
load package3 truck1 airport1
1
2 0
1
0 8 0 11
1
end_operator
begin_operator
load package3 truck1 place1-1
1
2 1
1
0 8 3 11
1
end_operator
begin_operator
load package3 truck1 place1-2
1
2 2
1
0 8 4 11
1
end_operator
begin_operator
load package3 truck2 airport2
1
1 0
1
0 8 1 12
1
end_operator
begin_operator
load package3 truck2 place2-1
1
1 1
1
0 8 5 12
1
end_operator
begin_operator
load package3 truck2 place2-2
1
1 2
1
0 8 6 12
1
end_operator
begin_operator
load package3 truck3 airport3
1
0 0
1
0 8 2 13
1
end_operator
begin_operator
load package3 truck3 place3-1
1
0 1
1
0 8 7 13
1
end_operator
begin_operator
load package3 truck3 place3-2
1
0 2
1
0 8 8 13
1
end_operator
begin_operator
load package4 plane1 airport1
1
4 0
1
0 7 0 9
1
end_operator
begin_operator
load package4 plane1 airport2
1
4 1
1
0 7 1 9
1
end_operator
begin_operator
load package4 plane1 airport3
1
4 2
1
0 7 2 9
1
end_operator
begin_operator
load package4 plane2 airport1
1
3 0
1
0 7 0 10
1
end_operator
begin_operator
load package4 plane2 airport2
1
3 1
1
0 7 1 10
1
end_operator
begin_operator
load package4 plane2 airport3
1
3 2
1
0 7 2 10
1
end_operator
begin_operator
load package4 truck1 airport1
1
2 0
1
0 7 0 11
1
end_operator
begin_operator
load package4 truck1 place1-1
1
2 1
1
0 7 3 11
1
end_operator
begin_operator
load package4 truck1 place1-2
1
2 2
1
0 7 4 11
1
end_operator
begin_operator
load package4 truck2 airport2
1
1 0
1
0 7 1 12
1
end_operator
begin_operator
load package4 truck2 place2-1
1
1 1
1
0 7 5 12
1
end_operator
begin_operator
load package4 truck2 place2-2
1
1 2
1
0 7 6 12
1
end_operator
begin_operator
load package4 truck3 airport3
1
0 0
1
0 7 2 13
1
end_operator
begin_operator
load package4 truck3 place3-1
1
0 1
1
0 7 7 13
1
end_operator
begin_operator
load package4 truck3 place3-2
1
0 2
1
0 7 8 13
1
end_operator
begin_operator
load package5 plane1 airport1
1
4 0
1
0 6 0 9
1
end_operator
begin_operator
load package5 plane1 airport2
1
4 1
1
0 6 1 9
1
end_operator
begin_operator
load package5 plane1 airport3
1
4 2
1
0 6 2 9
1
end_operator
begin_operator
load package5 plane2 airport1
1
3 0
1
0 6 0 10
1
end_operator
begin_operator
load package5 plane2 airport2
1
3 1
1
0 6 1 10
1
end_operator
begin_operator
load package5 plane2 airport3
1
3 2
1
0 6 2 10
1
end_operator
begin_operator
load package5 truck1 airport1
1
2 0
1
0 6 0 11
1
end_operator
begin_operator
load package5 truck1 place1-1
1
2 1
1
0 6 3 11
1
end_operator
begin_operator
load package5 truck1 place1-2
1
2 2
1
0 6 4 11
1
end_operator
begin_operator
load package5 truck2 airport2
1
1 0
1
0 6 1 12
1
end_operator
begin_operator
load package5 truck2 place2-1
1
1 1
1
0 6 5 12
1
end_operator
begin_operator
load package5 truck2 place2-2
1
1 2
1
0 6 6 12
1
end_operator
begin_operator
load package5 truck3 airport3
1
0 0
1
0 6 2 13
1
end_operator
begin_operator
load package5 truck3 place3-1
1
0 1
1
0 6 7 13
1
end_operator
begin_operator
load package5 truck3 place3-2
1
0 2
1
0 6 8 13
1
end_operator
begin_operator
load package6 plane1 airport1
1
4 0
1
0 5 0 9
1
end_operator
begin_operator
load package6 plane1 airport2
1
4 1
1
0 5 1 9
1
end_operator
begin_operator
load package6 plane1 airport3
1
4 2
1
0 5 2 9
1
end_operator
begin_operator
load package6 plane2 airport1
1
3 0
1
0 5 0 10
1
end_operator
begin_operator
load package6 plane2 airport2
1
3 1
1
0 5 1 10
1
end_operator
begin_operator
load package6 plane2 airport3
1
3 2
1
0 5 2 10
1
end_operator
begin_operator
load package6 truck1 airport1
1
2 0
1
0 5 0 11
1
end_operator
begin_operator
load package6 truck1 place1-1
1
2 1
1
0 5 3 11
1
end_operator
begin_operator
load package6 truck1 place1-2
1
2 2
1
0 5 4 11
1
end_operator
begin_operator
load package6 truck2 airport2
1
1 0
1
0 5 1 12
1
end_operator
begin_operator
load package6 truck2 place2-1
1
1 1
1
0 5 5 12
1
end_operator
begin_operator
load package6 truck2 place2-2
1
1 2
1
0 5 6 12
1
end_operator
begin_operator
load package6 truck3 airport3
1
0 0
1
0 5 2 13
1
end_operator
begin_operator
load package6 truck3 place3-1
1
0 1
1
0 5 7 13
1
end_operator
begin_operator
load package6 truck3 place3-2
1
0 2
1
0 5 8 13
1
end_operator
begin_operator
unload package1 plane1 airport1
1
4 0
1
0 10 9 0
1
end_operator
begin_operator
unload package1 plane1 airport2
1
4 1
1
0 10 9 1
1
end_operator
begin_operator
unload package1 plane1 airport3
1
4 2
1
0 10 9 2
1
end_operator
begin_operator
unload package1 plane2 airport1
1
3 0
1
0 10 10 0
1
end_operator
begin_operator
unload package1 plane2 airport2
1
3 1
1
0 10 10 1
1
end_operator
begin_operator
unload package1 plane2 airport3
1
3 2
1
0 10 10 2
1
end_operator
begin_operator
unload package1 truck1 airport1
1
2 0
1
0 10 11 0
1
end_operator
begin_operator
unload package1 truck1 place1-1
1
2 1
1
0 10 11 3
1
end_operator
begin_operator
unload package1 truck1 place1-2
1
2 2
1
0 10 11 4
1
end_operator
begin_operator
unload package1 truck2 airport2
1
1 0
1
0 10 12 1
1
end_operator
begin_operator
unload package1 truck2 place2-1
1
1 1
1
0 10 12 5
1
end_operator
begin_operator
unload package1 truck2 place2-2
1
1 2
1
0 10 12 6
1
end_operator
begin_operator
unload package1 truck3 airport3
1
0 0
1
0 10 13 2
1
end_operator
begin_operator
unload package1 truck3 place3-1
1
0 1
1
0 10 13 7
1
end_operator
begin_operator
unload package1 truck3 place3-2
1
0 2
1
0 10 13 8
1
end_operator
begin_operator
unload package2 plane1 airport1
1
4 0
1
0 9 9 0
1
end_operator
begin_operator
unload package2 plane1 airport2
1
4 1
1
0 9 9 1
1
end_operator
begin_operator
unload package2 plane1 airport3
1
4 2
1
0 9 9 2
1
end_operator
begin_operator
unload package2 plane2 airport1
1
3 0
1
0 9 10 0
1
end_operator
begin_operator
unload package2 plane2 airport2
1
3 1
1
0 9 10 1
1
end_operator
begin_operator
unload package2 plane2 airport3
1
3 2
1
0 9 10 2
1
end_operator
begin_operator
unload package2 truck1 airport1
1
2 0
1
0 9 11 0
1
end_operator
begin_operator
unload package2 truck1 place1-1
1
2 1
1
0 9 11 3
1
end_operator
begin_operator
unload package2 truck1 place1-2
1
2 2
1
0 9 11 4
1
end_operator
begin_operator
unload package2 truck2 airport2
1
1 0
1
0 9 12 1
1
end_operator
begin_operator
unload package2 truck2 place2-1
1
1 1
1
0 9 12 5
1
end_operator
begin_operator
unload package2 truck2 place2-2
1
1 2
1
0 9 12 6
1
end_operator
begin_operator
unload package2 truck3 airport3
1
0 0
1
0 9 13 2
1
end_operator
begin_operator
unload package2 truck3 place3-1
1
0 1
1
0 9 13 7
1
end_operator
begin_operator
unload package2 truck3 place3-2
1
0 2
1
0 9 13 8
1
end_operator
begin_operator
unload package3 plane1 airport1
1
4 0
1
0 8 9 0
1
end_operator
begin_operator
unload package3 plane1 airport2
1
4 1
1
0 8 9 1
1
end_operator
begin_operator
unload package3 plane1 airport3
1
4 2
1
0 8 9 2
1
end_operator
begin_operator
unload package3 plane2 airport1
1
3 0
1
0 8 10 0
1
end_operator
begin_operator
unload package3 plane2 airport2
1
3 1
1
0 8 10 1
1
end_operator
begin_operator
unload package3 plane2 airport3
1
3 2
1
0 8 10 2
1
end_operator
begin_operator
unload package3 truck1 airport1
1
2 0
1
0 8 11 0
1
end_operator
begin_operator
unload package3 truck1 place1-1
1
2 1
1
0 8 11 3
1
end_operator
begin_operator
unload package3 truck1 place1-2
1
2 2
1
0 8 11 4
1
end_operator
begin_operator
unload package3 truck2 airport2
1
1 0
1
0 8 12 1
1
end_operator
begin_operator
unload package3 truck2 place2-1
1
1 1
1
0 8 12 5
1
end_operator
begin_operator
unload package3 truck2 place2-2
1
1 2
1
0 8 12 6
1
end_operator
begin_operator
unload package3 truck3 airport3
1
0 0
1
0 8 13 2
1
end_operator
begin_operator
unload package3 truck3 place3-1
1
0 1
1
0 8 13 7
1
end_operator
begin_operator
unload package3 truck3 place3-2
1
0 2
1
0 8 13 8
1
end_operator
begin_operator
unload package4 plane1 airport1
1
4 0
1
0 7 9 0
1
end_operator
begin_operator
unload package4 plane1 airport2
1
4 1
1
0 7 9 1
1
end_operator
begin_operator
unload package4 plane1 airport3
1
4 2
1
0 7 9 2
1
end_operator
begin_operator
unload package4 plane2 airport1
1
3 0
1
0 7 10 0
1
end_operator
begin_operator
unload package4 plane2 airport2
1
3 1
1
0 7 10 1
1
end_operator
begin_operator
unload package4 plane2 airport3
1
3 2
1
0 7 10 2
1
end_operator
begin_operator
unload package4 truck1 airport1
1
2 0
1
0 7 11 0
1
end_operator
begin_operator
unload package4 truck1 place1-1
1
2 1
1
0 7 11 3
1
end_operator
begin_operator
unload package4 truck1 place1-2
1
2 2
1
0 7 11 4
1
end_operator
begin_operator
unload package4 truck2 airport2
1
1 0
1
0 7 12 1
1
end_operator
begin_operator
unload package4 truck2 place2-1
1
1 1
1
0 7 12 5
1
end_operator
begin_operator
unload package4 truck2 place2-2
1
1 2
1
0 7 12 6
1
end_operator
begin_operator
unload package4 truck3 airport3
1
0 0
1
0 7 13 2
1
end_operator
begin_operator
unload package4 truck3 place3-1
1
0 1
1
0 7 13 7
1
end_operator
begin_operator
unload package4 truck3 place3-2
1
0 2
1
0 7 13 8
1
end_operator
begin_operator
unload package5 plane1 airport1
1
4 0
1
0 6 9 0
1
end_operator
begin_operator
unload package5 plane1 airport2
1
4 1
1
0 6 9 1
1
end_operator
begin_operator
unload package5 plane1 airport3
1
4 2
1
0 6 9 2
1
end_operator
begin_operator
unload package5 plane2 airport1
1
3 0
1
0 6 10 0
1
end_operator
begin_operator
unload package5 plane2 airport2
1
3 1
1
0 6 10 1
1
end_operator
begin_operator
unload package5 plane2 airport3
1
3 2
1
0 6 10 2
1
end_operator
begin_operator
unload package5 truck1 airport1
1
2 0
1
0 6 11 0
1
end_operator
begin_operator
unload package5 truck1 place1-1
1
2 1
1
0 6 11 3
1
end_operator
begin_operator
unload package5 truck1 place1-2
1
2 2
1
0 6 11 4
1
end_operator
begin_operator
unload package5 truck2 airport2
1
1 0
1
0 6 12 1
1
end_operator
begin_operator
unload package5 truck2 place2-1
1
1 1
1
0 6 12 5
1
end_operator
begin_operator
unload package5 truck2 place2-2
1
1 2
1
0 6 12 6
1
end_operator
begin_operator
unload package5 truck3 airport3
1
0 0
1
0 6 13 2
1
end_operator
begin_operator
unload package5 truck3 place3-1
1
0 1
1
0 6 13 7
1
end_operator
begin_operator
unload package5 truck3 place3-2
1
0 2
1
0 6 13 8
1
end_operator
begin_operator
unload package6 plane1 airport1
1
4 0
1
0 5 9 0
1
end_operator
begin_operator
unload package6 plane1 airport2
1
4 1
1
0 5 9 1
1
end_operator
begin_operator
unload package6 plane1 airport3
1
4 2
1
0 5 9 2
1
end_operator
begin_operator
unload package6 plane2 airport1
1
3 0
1
0 5 10 0
1
end_operator
begin_operator
unload package6 plane2 airport2
1
3 1
1
0 5 10 1
1
end_operator
begin_operator
unload package6 plane2 airport3
1
3 2
1
0 5 10 2
1
end_operator
begin_operator
unload package6 truck1 airport1
1
2 0
1
0 5 11 0
1
end_operator
begin_operator
unload package6 truck1 place1-1
1
2 1
1
0 5 11 3
1
end_operator
begin_operator
unload package6 truck1 place1-2
1
2 2
1
0 5 11 4
1
end_operator
begin_operator
unload package6 truck2 airport2
1
1 0
1
0 5 12 1
1
end_operator
begin_operator
unload package6 truck2 place2-1
1
1 1
1
0 5 12 5
1
end_operator
begin_operator
unload package6 truck2 place2-2
1
1 2
1
0 5 12 6
1
end_operator
begin_operator
unload package6 truck3 airport3
1
0 0
1
0 5 13 2
1
end_operator
begin_operator
unload package6 truck3 place3-1
1
0 1
1
0 5 13 7
1
end_operator
begin_operator
unload package6 truck3 place3-2
1
0 2
1
0 5 13 8
1
end_operator
0
